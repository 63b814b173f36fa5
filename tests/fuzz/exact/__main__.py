"""``python -m tests.fuzz.exact``: judge many drawn graphs, and print what is bad."""

import argparse
import concurrent.futures
import multiprocessing
import sys

from tests.fuzz.exact.judging import findings

TOLD_EVERY = 1000


def main() -> int:
    """Judge a range of seeds on some processes; 1 if something is bad."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.exact")
    parser.add_argument("--graphs", type=int, default=20000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    seeds, bad = range(given.first, given.first + given.graphs), 0
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(given.jobs, context) as pool:
        for seed, told in zip(
            seeds, pool.map(findings, seeds, chunksize=25), strict=True
        ):
            bad += len(told)
            for text in told:
                print(text, flush=True)  # noqa: T201
            if (seed + 1) % TOLD_EVERY == 0:
                line = f"up to seed {seed}: {bad} bad"
                print(line, file=sys.stderr, flush=True)  # noqa: T201
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
