"""Questions 1 and 2 of the README: the road's answer to the five methods.

    python -m benchmarks.observers.drives ROUTES.csv ...

Each file is what ``benchmarks.bench_study`` wrote of one recording.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.bench_intervals import KeptDrive, kept_drives, told
from me2e_compress.metrics.differences import holm

METHODS = ("max-min", "moving-average", "percentile", "mse", "entropy")
"""Those that were driven; two of them are gone since."""
MARGIN = 2.0
FLIPS, SEED = 20_000, 0


def mean_of(drives: list[KeptDrive]) -> KeptDrive:
    """The mean over recordings of each route."""
    return KeptDrive(
        {
            route: tuple(np.mean([each.scores[route] for each in drives], 0).tolist())
            for route in drives[0].scores
        },
        drives[0].bounds,
    )


def sign_flip(gap: KeptDrive) -> float:
    """Two-sided p-value that the mean is 0, each type's sum of either sign alike."""
    sums = dict.fromkeys(gap.types, 0.0)
    for kind, (score, _) in zip(gap.types, gap.scores.values(), strict=True):
        sums[kind] += score
    found = np.array(list(sums.values()))
    signs = np.random.default_rng(SEED).choice((-1.0, 1.0), (FLIPS, len(found)))
    beyond = np.abs(signs @ found) >= abs(found.sum()) - 1e-9
    return float((1 + beyond.sum()) / (FLIPS + 1))


def differences(drives: Mapping[str, KeptDrive]) -> dict[str, KeptDrive]:
    """Each method minus max-min, by route, the mean over recordings."""
    by_method: dict[str, list[KeptDrive]] = {method: [] for method in METHODS}
    for name, drive in drives.items():
        method = name.partition(".")[0].rpartition("-")[0]
        if method in by_method:
            by_method[method].append(drive)
    means = {method: mean_of(drives) for method, drives in by_method.items()}
    first = means.pop("max-min")
    return {method: mean - first for method, mean in means.items()}


def main(files: list[Path]) -> None:
    drives = {name: e for path in files for name, e in kept_drives(path).items()}
    for name, drive in drives.items():
        print(f"{name}: {told(drive)}")
    gaps = differences(drives)
    corrected = holm([sign_flip(gap) for gap in gaps.values()])
    print("method | minus max-min, points | types anew | p (Holm) | no worse by 2")
    print("---|---:|---:|---:|---")
    for (method, gap), p in zip(gaps.items(), corrected, strict=True):
        mean = gap.mean()
        if mean.value is None or mean.anew_low is None or mean.anew_high is None:
            raise SystemExit(f"{method}: too few routes for an interval")
        answer = "yes" if mean.anew_low > -MARGIN else "not shown"
        print(
            f"{method} | {mean.value:+.2f} | {mean.anew_low:+.2f} to"
            f" {mean.anew_high:+.2f} | {p:.3f} | {answer}"
        )


if __name__ == "__main__":
    main([Path(each) for each in sys.argv[1:]])
