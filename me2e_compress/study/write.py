"""What a study leaves on disk: JSON for programs, Markdown, one HTML page."""

from dataclasses import dataclass
from pathlib import Path

from me2e_compress.errors import StudyError
from me2e_compress.runtime.atomic import write_bytes, write_json
from me2e_compress.study.outcome import Outcome
from me2e_compress.study.tables import all_tables

JSON, MARKDOWN = "study.json", "tables.md"


@dataclass(frozen=True)
class Written:
    """The files of a study.

    Attributes:
        record: JSON, everything that was found.
        tables: Markdown.
    """

    record: Path
    tables: Path


def write_tables(outcome: Outcome, folder: Path) -> Written:
    """Write JSON and Markdown, each whole or not at all.

    Raises:
        StudyError: The folder cannot be written.
    """
    written = Written(folder / JSON, folder / MARKDOWN)
    heading = f"# {outcome.study.title}\n\n"
    text = heading + "\n".join(table.markdown() for table in all_tables(outcome))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(written.record, outcome.to_json(), indent=1)
        write_bytes(written.tables, text.encode())
    except OSError as error:
        raise StudyError(f"{folder}: cannot be written: {error.strerror}") from error
    return written
