"""The paper's questions, asked of the drives of a study.

    me2e-compress study benchmarks/paper/paper.toml -o OUT --workers 2   # hours
    python -m benchmarks.paper OUT -o page.html   # weighs its files, draws the page
    python -m benchmarks.paper OUT --keep         # keeps its records, writes paper.md
    python -m benchmarks.paper                    # writes paper.md of what is kept

Nothing is driven but the last seconds of one accident. What is kept,
``benchmarks/road_2/paper/``, is a line a route, and the latencies that were charged
(``traces/``).
"""

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.measure.study import told
from benchmarks.paper.drives import FILE
from benchmarks.paper.questions import SHIPPED
from benchmarks.paper.records import RECORDS, add_facts, files, read_paper
from benchmarks.paper.result import paper_page
from me2e_compress.base.atomic import write_bytes
from me2e_compress.base.errors import Me2eError
from me2e_compress.study import load_study

ROOT = Path(__file__).parents[2]
PAPER = Path(__file__).parent
TRACES = "traces"
HEAD = """\
# The paper, re-tested

    me2e-compress study benchmarks/paper/paper.toml -o paper --workers 2
    python -m benchmarks.paper paper -o page.html

ask the questions of the paper that this toolkit follows (*Software-Hardware Co-optimization for Modular E2E AV Paradigm: A Unified Framework of Optimization Approaches, Simulation Environment and Evaluation Metrics*, arXiv 2601.07393) of the driver that ships, on the 220 routes of highway-env: its tables 2 to 6, figures 5 to 7, the share of collisions by partner, and each of its findings as a question. `--dry-run` says what that drives, in hours on two cores. It goes on where it was ended, `--tables table-2,table-3` drives a part, and `--routes 44` is a preview, which every title says.

The questions, with test, edge, interval and correction, stand in [a file](questions.toml). Where records know the file that they were driven for, a question that was added or changed later is marked so. A difference is sure where its p-value, over whole scenario types drawn anew and corrected by Holm over the page, is below 0.05; "no worse" is no more than 2 points of driving score worse. Latencies are compared by medians of five separated runs; EER_AV only where all normalizations agree; and where a median lies within noise of a step of equation 4, a frame's worth of driving score is taken off. A verdict is of this driver on this road: highway-env confirms nothing about CARLA.

Energy is measured where the machine has a counter; what is modelled from MACs and bytes stands in columns of its own. `--stack FOLDER` counts another stack's files in table 4, such as VAD-tiny's:

    python -m models.export vad-tiny -o vad-tiny.onnx
    python -m models.frames vad-tiny -n 8 -o vad-frames
    for scheme in prediction feature-ext full; do
      me2e-compress compress vad-tiny.onnx -r $scheme --frames vad-frames -o vad-tiny/$scheme.onnx
    done

"""  # noqa: E501 - a paragraph of the page is one line
NOTHING = "Not driven yet. Its answers will stand here.\n"


@dataclass(frozen=True)
class Page:
    """The page of a study with the paper's questions, and the drives kept for it."""

    study: Path
    kept: Path
    path: Path
    head: str
    command: str

    def text(self, asked_at: str, records: Path | None = None) -> str:
        """Write the page of a folder of finished drives; of none it says so.

        ``asked_at`` is when the questions were committed; empty if nobody knows.

        Raises:
            StudyError: A file cannot be read.
        """
        records = records or self.kept
        if not (records / FILE).is_file():
            return self.head + NOTHING
        found = read_paper(load_study(self.study), records)
        since = f"committed {asked_at}" if asked_at else "not committed"
        kept = self.kept.relative_to(ROOT)
        answer = (
            f"{found.verdicts} {found.headline}; driven on"
            f" {found.machine}; questions {since}. All of this is written by"
            f" `{self.command}` from [every route](../../{kept}); `-o PAGE.html` draws"
            " the figures.\n\n"
        )
        return (
            self.head + answer + "\n".join(each.markdown() for each in found.tables())
        )

    def keep(self, records: Path) -> None:
        """Copy the finished drives, and the latencies of their models."""
        (self.kept / TRACES).mkdir(parents=True, exist_ok=True)
        study = load_study(self.study)
        asked = files(study)
        for path in sorted(records.iterdir()):
            if path.suffix in (".json", ".toml") or path.name in asked:
                shutil.copyfile(path, self.kept / path.name)
        for path in sorted((records.parent / TRACES).glob("*.json")):
            shutil.copyfile(path, self.kept / TRACES / path.name)


def committed(path: Path) -> str:
    """Return when a file last changed by a commit; empty where git does not know it."""
    options = ("-1", "--follow", "--diff-filter=AM", "--format=%cI")
    command = ("git", "log", *options, "--", path)
    try:
        found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    except OSError:
        return ""
    return found.stdout.strip()


PAGE = Page(
    PAPER / "paper.toml",
    ROOT / "benchmarks" / "road_2" / "paper",
    PAPER / "paper.md",
    HEAD,
    "python -m benchmarks.paper",
)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path, nargs="?", help="folder of the study")
    parser.add_argument("-o", dest="html", type=Path, help="draw the page, as HTML")
    parser.add_argument("--keep", action="store_true", help="keep its records here")
    parser.add_argument(
        "--stack", type=Path, action="append", default=[], help="with OUT: for table 4"
    )
    given = parser.parse_args(argv)
    page = PAGE
    try:
        records = page.kept
        if given.out is not None:
            add_facts(load_study(page.study), given.out, given.stack, told())
            records = given.out / RECORDS
        if given.html is not None:
            found = read_paper(load_study(page.study), records)
            drawn = paper_page(found, " ".join((page.command, *sys.argv[1:])))
            write_bytes(given.html, drawn.html().encode())
        if given.keep:
            page.keep(records)
        if given.keep or given.html is None:
            write_bytes(page.path, page.text(committed(SHIPPED)).encode())
    except Me2eError as error:
        sys.exit(f"benchmarks.paper: {error}")


if __name__ == "__main__":
    main()
