"""Files that the paper's study writes."""

from collections.abc import Sequence
from pathlib import Path

from me2e_compress import drafts
from me2e_compress.display import in_markdown
from me2e_compress.errors import StudyError
from me2e_compress.runtime.atomic import write_bytes, write_json
from me2e_compress.study.paper.paper_page import paper_html
from me2e_compress.study.paper.paper_result import PaperResult
from me2e_compress.study.workspace import HTML, JSON, MARKDOWN
from me2e_compress.workflows.claims import writing


def write_paper(
    result: PaperResult,
    folder: str | Path,
    command: Sequence[str] = (),
    *,
    force: bool = False,
) -> tuple[Path, ...]:
    """Write page, Markdown and JSON, each atomically; return the files.

    ``command`` is the command line that reproduces them; ``force`` also replaces files
    that were changed since we wrote them.
    """
    folder = Path(folder)
    report, tables, record = folder / HTML, folder / MARKDOWN, folder / JSON
    heading = f"# {in_markdown(result.title)}\n\n"
    text = heading + "\n".join(table.markdown() for table in result.tables())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (
            writing([report, tables, record], force=force),
            drafts.all_or_none(),
        ):
            write_json(record, result.to_json(), indent=1)
            write_bytes(tables, text.encode())
            write_bytes(report, paper_html(result, command).encode())
    except OSError as error:
        raise StudyError(f"{folder}: cannot be written: {error.strerror}") from error
    return report, tables, record
