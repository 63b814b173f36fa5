"""Do the intervals over routes hold the truth? And how alike are routes of one type?

``python -m benchmarks.bench_intervals [RESULTS...]`` draws sets of 44 types with 5
routes, alike within a type, and prints how often each 95 % interval holds the mean of
those types, and that of all types. Of folders of results it prints how alike the
driving scores of a type are, and those of the differences to the first folder.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from me2e_compress.evaluators.highway.results import ResultsFolder
from me2e_compress.metrics.driving_score import route_score
from me2e_compress.metrics.intervals import mean_estimate

TYPES, VARIANTS = 44, 5
Scores = Mapping[str, tuple[str, float]]
"""Type and driving score by route."""


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
    return float((between - within) / (between + (size - 1.0) * within))


def scores_of(folder: Path) -> Scores:
    """Read the driving score of every route of a folder of results."""
    episodes = ResultsFolder.open(folder).episodes().values()
    return {e.route: (e.scenario, route_score(e).composed) for e in episodes}


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", nargs="*", type=Path)
    parser.add_argument("--simulations", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    for correlation in (0.0, 0.3, 0.55):
        held = coverage(correlation, asked.simulations, asked.seed)
        told = ", ".join(f"{name} {share:.1%}" for name, share in held.items())
        print(f"correlation {correlation:.2f}: the 95 % interval holds {told}")
    folders = [scores_of(each) for each in asked.results]
    for path, scores in zip(asked.results, folders, strict=True):
        print(f"{path}: correlation {intra_type_correlation([*scores.values()]):.2f}")
        if scores is not folders[0]:
            first = folders[0]
            gaps = [(kind, value - first[r][1]) for r, (kind, value) in scores.items()]
            print(f"  of the differences: {intra_type_correlation(gaps):.2f}")


if __name__ == "__main__":
    main()
