"""Do the intervals over routes hold the truth? And what do kept drives show?

``python -m benchmarks.measure.intervals`` draws sets of 44 types with 5 routes, alike
within a type, and prints how often each 95 % interval holds the mean of those types,
and that of all types.

    python -m benchmarks.measure.intervals benchmarks/road_2/trained/four/routes.csv
    python -m benchmarks.measure.intervals ROUTES.csv ... --minus minus-track.ideal

prints of kept drives, ``SCHEME.CONDITION``, the driving score and the success with both
intervals, and how alike the scores of a type are; then the same of the differences to
the first scheme under the same condition, or to ``--minus``.
"""

import argparse
import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from me2e_compress.metrics.measure import Estimate, mean_estimate

TYPES, VARIANTS = 44, 5


@dataclass(frozen=True)
class KeptDrive:
    """Driving score and success in percent, by route; or differences of both."""

    scores: Mapping[str, tuple[float, float]]
    bounds: tuple[float, float] = (0.0, 100.0)

    def __sub__(self, other: "KeptDrive") -> "KeptDrive":
        gaps = {
            route: (score - other.scores[route][0], rate - other.scores[route][1])
            for route, (score, rate) in self.scores.items()
        }
        low, high = self.bounds[0] - other.bounds[1], self.bounds[1] - other.bounds[0]
        return KeptDrive(gaps, (low, high))

    @property
    def types(self) -> list[str]:
        """Scenario type of each route: ``Accident_R2_0`` is of ``Accident``."""
        return [route.rpartition("_")[0].removesuffix("_R2") for route in self.scores]

    def mean(self, column: int = 0) -> Estimate:
        """Return the mean of the driving score (0) or of the success (1)."""
        values = [each[column] for each in self.scores.values()]
        return mean_estimate(values, self.types, "%", bounds=self.bounds)

    @property
    def correlation(self) -> float | None:
        """Correlation of the driving scores of two routes of a type.

        None where it is not measured: one type alone, or a type of one route.
        """
        counts = Counter(self.types)
        if len(counts) < 2 or min(counts.values()) < 2:
            return None
        values = [score for score, _ in self.scores.values()]
        return intra_type_correlation([*zip(self.types, values, strict=True)])

    @property
    def scatter(self) -> float:
        """Standard deviation of the driving score over routes."""
        return float(np.std([score for score, _ in self.scores.values()], ddof=1))


def coverage(correlation: float, simulations: int, seed: int) -> Mapping[str, float]:
    """Return how often each interval holds each mean, as shares.

    Args:
        correlation: Of two routes of one type.
        simulations: How many sets are drawn.
        seed: Of the draws.
    """
    random, types = np.random.default_rng(seed), np.repeat(np.arange(TYPES), VARIANTS)
    held = np.zeros(3)
    for each in range(simulations):
        shared = random.normal(0.0, np.sqrt(correlation), TYPES)
        own = random.normal(0.0, np.sqrt(1.0 - correlation), TYPES * VARIANTS)
        values = shared[types] + own
        found = mean_estimate(values.tolist(), types.astype(str).tolist(), "", each)
        here, truth = (found.low or 0.0, found.high or 0.0), float(shared.mean())
        anew = found.anew_low or 0.0, found.anew_high or 0.0
        held += [
            here[0] <= truth <= here[1],
            anew[0] <= 0.0 <= anew[1],
            here[0] <= 0.0 <= here[1],
        ]
    names = ("these types", "types anew", "types anew by the interval of these types")
    return dict(zip(names, (held / simulations).tolist(), strict=True))


def intra_type_correlation(rows: Sequence[tuple[str, float]]) -> float:
    """Return ICC(1) (Shrout and Fleiss 1979) of values by type, one-way analysis."""
    groups: dict[str, list[float]] = {}
    for kind, value in rows:
        groups.setdefault(kind, []).append(value)
    size = len(rows) / len(groups)
    between = size * np.var([np.mean(each) for each in groups.values()], ddof=1)
    within = np.mean([np.var(each, ddof=1) for each in groups.values()])
    return float((between - within) / max(between + (size - 1.0) * within, 1e-12))


def kept_drives(path: Path) -> dict[str, KeptDrive]:
    """Read the drives of a ``routes.csv`` by ``SCHEME.CONDITION``."""
    found = dict[str, dict[str, tuple[float, float]]]()
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            scores = found.setdefault(f"{row['scheme']}.{row['condition']}", {})
            score = float(row["driving_score_percent"])
            scores[row["route"]] = score, 100.0 * int(row["succeeded"])
    return {name: KeptDrive(scores) for name, scores in found.items()}


def told(drive: KeptDrive) -> str:
    """Say both means with both intervals, and how alike the scores of a type are.

    The interval over types drawn anew and the correlation are left out where they are
    not measured.
    """
    said = []
    for column, name in enumerate(("DS", "SR")):
        mean = drive.mean(column)
        bounds = f"{mean.low:.1f} to {mean.high:.1f}"
        if mean.anew_low is not None:
            bounds += f"; types anew {mean.anew_low:.1f} to {mean.anew_high:.1f}"
        said.append(f"{name} {mean.value:.1f} ({bounds})")
    if drive.correlation is not None:
        said.append(f"correlation {drive.correlation:.2f}")
    return ", ".join((*said, f"scatter {drive.scatter:.1f}"))


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("routes", nargs="*", type=Path, help="routes.csv of drives")
    parser.add_argument("--minus", help="SCHEME.CONDITION")
    parser.add_argument("--simulations", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    if not asked.routes:
        for correlation in (0.0, 0.3, 0.55):
            held = coverage(correlation, asked.simulations, asked.seed)
            said = ", ".join(f"{name} {share:.1%}" for name, share in held.items())
            print(f"correlation {correlation:.2f}: the 95 % interval holds {said}")
        return
    drives = {n: e for path in asked.routes for n, e in kept_drives(path).items()}
    first = next(iter(drives)).partition(".")[0]
    for name, drive in drives.items():
        print(f"{name}: {told(drive)}")
        minus = asked.minus or f"{first}.{name.partition('.')[2]}"
        if minus != name:
            print(f"  minus {minus}: {told(drive - drives[minus])}")


if __name__ == "__main__":
    main()
