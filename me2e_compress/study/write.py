"""Files that a study writes: JSON for programs, Markdown, one HTML page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from me2e_compress.display import in_markdown
from me2e_compress.errors import StudyError
from me2e_compress.registry import drafts
from me2e_compress.runtime.atomic import write_bytes, write_document
from me2e_compress.study.report.page import Section
from me2e_compress.study.report.study_page import study_page
from me2e_compress.study.study_result import StudyResult
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN
from me2e_compress.workflows.checks import writing


@dataclass(frozen=True)
class StudyFiles:
    """Paths of the JSON record, Markdown tables and HTML report of a study."""

    record: Path
    tables: Path
    report: Path


def write_study(
    outcome: StudyResult,
    folder: str | Path,
    command: Sequence[str] = (),
    sections: Sequence[Section] = (),
    *,
    force: bool = False,
) -> StudyFiles:
    """Write JSON, Markdown and HTML, each atomically.

    Args:
        outcome: Results to write.
        folder: Created if needed.
        command: The command line that reproduces the study, word by word.
        sections: Additional sections of the page.
        force: Also replace files that we did not write.

    Raises:
        StudyError: The folder cannot be written.
        GraphError: A file is there that we did not write.
    """
    # paths, and all tables as Markdown
    folder = Path(folder)
    written = StudyFiles(folder / JSON, folder / MARKDOWN, folder / HTML)
    heading = f"{drafts.IN_MARKDOWN}# {in_markdown(outcome.title)}\n\n"
    text = heading + "\n".join(table.markdown() for table in outcome.tables())
    page = study_page(outcome, command, sections)
    # all files are written, or none
    with drafts.written(folder, StudyError):
        folder.mkdir(parents=True, exist_ok=True)
        with (
            writing([written.record, written.tables, written.report], force=force),
            drafts.all_or_none(),
        ):
            write_document(written.record, outcome.to_json(), indent=1)
            write_bytes(written.tables, text.encode())
            write_bytes(written.report, page.html().encode())
    return written
