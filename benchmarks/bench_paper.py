"""docs/paper.md, from the finished drives of the paper's study.

    me2e-compress study paper -o OUT --workers 2     # hours; goes on where it was ended
    python -m benchmarks.bench_paper OUT/records     # keeps them here, writes the page
    python -m benchmarks.bench_paper                 # writes the page of what is kept

Nothing is driven. What is kept, ``benchmarks/paper/``, is a line a route, and the
latencies that were charged (``traces/``). With ``--road 2`` it is
``benchmarks/road_2/paper/``, of the study ``benchmarks/road_2/paper.toml``.
"""

import argparse
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from me2e_compress.errors import Me2eError
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.study import load_study
from me2e_compress.study.paper.paper_drives import FILE
from me2e_compress.study.paper.paper_findings import Verdict
from me2e_compress.study.paper.paper_run import read_paper
from me2e_compress.study.paper.questions import SHIPPED
from me2e_compress.study.workspace import Workspace

ROOT = Path(__file__).parents[1]
TRACES = "traces"
HEAD = """\
# The paper, re-tested

    me2e-compress study paper -o paper --workers 2

asks the questions of the paper that this toolkit follows (*Software-Hardware Co-optimization for Modular E2E AV Paradigm: A Unified Framework of Optimization Approaches, Simulation Environment and Evaluation Metrics*, arXiv 2601.07393) of the driver that ships, on the 220 routes of highway-env: its tables 2 to 6, figures 5 to 7, the share of collisions by partner, and each of its findings as a question. `--dry-run` says what that drives, in hours on two cores; a second run takes seconds. It goes on where it was ended, `--tables 2,3` drives a part, and `--routes 44` is a preview, which every title says.

The questions, with test, edge, interval and correction, stand in [a file](../me2e_compress/study/paper/questions.toml) (a study of yours names its own, `questions = "FILE.toml"`). `records/` keeps the file as it was before the first drive, and each drive its digest: a question that was added or changed later is marked so. A difference is sure where its p-value, over whole scenario types drawn anew and corrected by Holm over the page, is below 0.05; "no worse" is no more than 2 points of driving score worse. Latencies are compared by medians of five separated runs; EER_AV only where all normalizations agree; and where a median lies within noise of a step of equation 4, a frame's worth of driving score is taken off. A verdict is of this driver on this road: highway-env confirms nothing about CARLA.

Energy is measured where the machine has a counter; what is modelled from MACs and bytes stands in columns of its own. `--weigh FOLDER` counts another stack's files in table 4, such as VAD-tiny's:

    me2e-compress export vad-tiny -o vad-tiny.onnx
    me2e-compress frames vad-tiny -n 8 -o vad-frames
    for scheme in prediction feature-ext full; do
      me2e-compress compress vad-tiny.onnx -r $scheme --frames vad-frames -o vad-tiny/$scheme.onnx
    done

"""  # noqa: E501 - a paragraph of the page is one line
HEAD_2 = """\
# The paper, re-tested on the second road

    me2e-compress study benchmarks/road_2/paper.toml -o paper-2 --workers 2

asks the [same questions](../me2e_compress/study/paper/questions.toml) of `highway-2` on the 220 routes of [the second road](closed-loop.md#the-second-road), where others come and go without minding it: how a finding is put, tested and read is told in [paper.md](paper.md).

"""  # noqa: E501 - a paragraph of the page is one line
NOTHING = "Not driven yet. Its answers will stand here.\n"


@dataclass(frozen=True)
class Page:
    """The page of a study with the paper's questions, and the drives kept for it."""

    study: str
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
        verdicts = [each.verdict for each in found.findings]
        counts = ", ".join(
            f"{verdicts.count(each)} {each.value}"
            for each in Verdict
            if each in verdicts
        )
        since = f"committed {asked_at}" if asked_at else "not committed"
        kept = self.kept.relative_to(ROOT)
        answer = (
            f"Of its {len(verdicts)} findings {counts}. {found.headline}; driven on"
            f" {found.machine}; questions {since}. All of this is written by"
            f" `{self.command}` from [every route](../{kept}), and"
            f" `study {self.study} --records {kept} -o OUT` draws the figures.\n\n"
        )
        return (
            self.head + answer + "\n".join(each.markdown() for each in found.tables())
        )

    def keep(self, records: Path) -> None:
        """Copy the finished drives, and the latencies of their models."""
        (self.kept / TRACES).mkdir(parents=True, exist_ok=True)
        study = load_study(self.study)
        asked = {
            f"{Workspace.drive(variant, each)}.jsonl"
            for each in study.conditions
            for variant in study.driven_under(each)
        }
        for path in sorted(records.iterdir()):
            if path.suffix in (".json", ".toml") or path.name in asked:
                shutil.copyfile(path, self.kept / path.name)
        for path in sorted((records.parent / TRACES).glob("*.json")):
            shutil.copyfile(path, self.kept / TRACES / path.name)


def committed(path: Path) -> str:
    """Return when a file was last committed; empty where git does not know it."""
    command = ("git", "log", "-1", "--format=%cI", "--", path)
    try:
        found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    except OSError:
        return ""
    return found.stdout.strip()


PAGES = {
    1: Page(
        "paper",
        ROOT / "benchmarks" / "paper",
        ROOT / "docs" / "paper.md",
        HEAD,
        "python -m benchmarks.bench_paper",
    ),
    2: Page(
        "benchmarks/road_2/paper.toml",
        ROOT / "benchmarks" / "road_2" / "paper",
        ROOT / "docs" / "paper-2.md",
        HEAD_2,
        "python -m benchmarks.bench_paper --road 2",
    ),
}
"""By road."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("records", type=Path, nargs="?", help="of a run: OUT/records")
    parser.add_argument("--road", type=int, default=1, choices=PAGES)
    given = parser.parse_args()
    page = PAGES[given.road]
    try:
        if given.records is not None:
            page.text("", given.records)  # what cannot be read is not kept
            page.keep(given.records)
        write_bytes(page.path, page.text(committed(SHIPPED)).encode())
    except Me2eError as error:
        sys.exit(f"bench_paper: {error}")


if __name__ == "__main__":
    main()
