"""Files that a study writes: JSON for programs, Markdown, one HTML page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from me2e_compress import drafts
from me2e_compress.display import in_markdown
from me2e_compress.errors import StudyError
from me2e_compress.runtime.atomic import write_bytes, write_json
from me2e_compress.study.all_tables import all_tables
from me2e_compress.study.outcome import StudyResult
from me2e_compress.study.report import Section, html
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN
from me2e_compress.workflows.claims import writing


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
        force: Also replace files that were changed since we wrote them.

    Raises:
        StudyError: The folder cannot be written.
        GraphError: A file was changed since we wrote it.
    """
    # paths, and all tables as Markdown
    folder = Path(folder)
    written = StudyFiles(folder / JSON, folder / MARKDOWN, folder / HTML)
    title = f"{outcome.study.title}{outcome.study.preview}"
    heading = f"# {in_markdown(title)}\n\n"
    text = heading + "\n".join(table.markdown() for table in all_tables(outcome))
    # all files are written, or none
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (
            writing([written.record, written.tables, written.report], force=force),
            drafts.all_or_none(),
        ):
            write_json(written.record, outcome.to_json(), indent=1)
            write_bytes(written.tables, text.encode())
            write_bytes(written.report, html(outcome, command, sections).encode())
    except OSError as error:
        raise StudyError(f"{folder}: cannot be written: {error.strerror}") from error
    return written
