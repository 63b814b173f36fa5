"""Run a study and write its report."""

from collections.abc import Sequence
from pathlib import Path

from me2e_compress.errors import StudyError
from me2e_compress.evaluators.highway.engine import Engine
from me2e_compress.study.definition import Study
from me2e_compress.study.paper.paper_run import read_paper
from me2e_compress.study.run import run_study
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.write import StudyFiles, write_study
from me2e_compress.workflows.listener import SILENT, Listener


def run_and_report(
    study: Study,
    folder: str | Path,
    command: Sequence[str] = (),
    engine: Engine | None = None,
    listener: Listener = SILENT,
    records: Path | None = None,
    weigh: Sequence[Path] = (),
    *,
    force: bool = False,
) -> tuple[StudyResult, StudyFiles]:
    """Run a study and write its report; the paper's tables are written block by block.

    ``command`` is the command line that reproduces it. With ``records``, a folder of
    finished drives, the paper's tables are made of these and nothing is driven;
    ``weigh`` are folders of other stacks' files for the paper's table 4. Returns the
    results and the files.

    Raises:
        StudyError: Records are given for a study that is not the paper's.
        Me2eError: See `run_study`.
    """
    if study.report == "comparison" and (records is not None or weigh):
        option = "--weigh" if records is None else "--records"
        raise StudyError(f"{option} is for a study with the paper's tables")
    if records is not None:
        read = read_paper(study, records, weigh)
        return read, write_study(read, folder, command, force=force)

    def land(so_far: StudyResult) -> None:
        write_study(so_far, folder, command, force=force)

    found = run_study(
        study, folder, engine, listener, on_block=land, weigh=weigh, force=force
    )
    return found, write_study(found, folder, command, force=force)
