"""``python -m tests.fuzz.exact``: judge many drawn graphs and print a table."""

import argparse
import sys
from pathlib import Path
from typing import get_args

from tests.fuzz.exact.judging import Kind
from tests.fuzz.exact.nightly import Tally, run

KINDS: tuple[str, ...] = get_args(Kind)


def main() -> int:
    """Run, print; 1 if a pass was found to do what no pass may."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.exact")
    parser.add_argument("--graphs", type=int, default=20000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/nightly"))
    given = parser.parse_args()
    path = given.out / "exact.jsonl"
    total = run(path, given.first, given.graphs, given.jobs, show_chunk)
    show(total)
    return int(total.bad > 0)


def show_chunk(chunk: Tally, total: Tally) -> None:
    """Print the findings of a chunk as they come."""
    for each in chunk.findings:
        head = f"{each['kind']}: seed {each['seed']}, {each['label']}: {each['detail']}"
        print(head[:300])  # noqa: T201
        if each["text"]:
            print(each["text"])  # noqa: T201
    line = f"{total.graphs} graphs, {total.bad} bad"
    print(line, file=sys.stderr)  # noqa: T201


def show(total: Tally) -> None:
    """Print how each pipeline ended, and on how many graphs each pass acted."""
    widest = 60
    lines = [f"{total.graphs} graphs", _row("", widest, ["runs", *KINDS])]
    for label, row in total.kinds.items():
        counts = [sum(row.values()), *(row.get(kind, 0) for kind in KINDS)]
        lines.append(_row(label, widest, [str(each) for each in counts]))
    lines.append("graphs on which each pass changed something:")
    lines += [f"  {name}: {count}" for name, count in sorted(total.changed.items())]
    lines.append("refusals:")
    lines += [f"  {count} x {said}" for said, count in sorted(total.refusals.items())]
    print("\n".join(lines))  # noqa: T201


def _row(label: str, widest: int, cells: list[str]) -> str:
    return f"{label[:widest]:{widest}} " + " ".join(f"{cell:>14}" for cell in cells)


if __name__ == "__main__":
    sys.exit(main())
