"""Tables, and how numbers, counts and names are written in them and in messages."""

import html
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

# The note of a table some of whose MACs are a lower bound
LOWER_BOUND = "≥ or -: plugins and open shapes are not counted; inspect names them"

# Control characters but the end of a line, marks that turn the direction of writing,
# and halves of characters: they steer a terminal, or no file can hold them.
_UNPRINTABLE = re.compile(
    "[\x00-\x09\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f"
    "\ud800-\udfff\ufeff\ufff9-\ufffb]"
)


def escape_controls(text: str) -> str:
    """Return a text with what cannot be seen, but ends of lines, as escapes."""
    return _UNPRINTABLE.sub(
        lambda match: match.group().encode("unicode_escape").decode(), text
    )


@dataclass(frozen=True)
class Cell:
    """A number or words; ``detail`` is its interval, ``reason`` why it is missing."""

    text: str
    detail: str = ""
    reason: str = ""


@dataclass(frozen=True)
class Table:
    """A table: the first columns are words, the others are numbers.

    Attributes:
        title: the line above it.
        columns: headings, with their units.
        rows: a cell for each column.
        note: what a reader must know; a few sentences, or a few lines.
        strong: name of the row that the others are compared with.
        words: how many of the first columns are words.
        details: lines below it that ``-v`` shows.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    strong: str = ""
    words: int = 1
    details: str = ""

    def escape_controls(self) -> "Table":
        """Return it with what cannot be seen as escapes, titles and cells on a line."""
        rows = (
            tuple(replace(cell, text=_escape_newlines(cell.text)) for cell in row)
            for row in self.rows
        )
        return replace(
            self,
            title=_escape_newlines(self.title),
            rows=tuple(rows),
            note=escape_controls(self.note),
            details=escape_controls(self.details),
        )

    def markdown(self) -> str:
        """Return GitHub's Markdown, intervals in brackets, every text escaped."""
        # Words stand left, numbers right
        rule = "|---|" + "---:|" * (len(self.columns) - 1)
        rows = [[escape_markdown(cell_text(cell)) for cell in row] for row in self.rows]
        lines = [_markdown_row(self.columns), rule, *map(_markdown_row, rows)]
        title = f"**{escape_markdown(self.title)}**"
        parts = [title, "\n".join(lines), *filter(None, [escape_markdown(self.note)])]
        return "\n\n".join(parts) + "\n"


def table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    note: str = "",
    words: int = 1,
    details: str = "",
) -> Table:
    """Build a table whose cells are plain texts."""
    cells = tuple(tuple(map(Cell, row)) for row in rows)
    return Table(title, tuple(columns), cells, note, words=words, details=details)


def format_number(value: float | None, form: str = ",.0f") -> str:
    """Write a number, never as a negative zero; a dash for what was not measured."""
    if value is None:
        return "-"
    # `form` is a format without fill, alignment or width, such as `+.1f`
    sign = "+" if form.startswith("+") else ""
    return format(value, f"{sign}z{form.removeprefix('+')}")


def format_significant(value: float | None, digits: int = 4) -> str:
    """Write a number in so many digits, without an exponent: 4,778,000 and 0.00012."""
    if value is None or not math.isfinite(value):
        return format_number(value)
    # All digits before the point are written, and none of the zeros at the end after it
    before = math.floor(math.log10(abs(value))) + 1 if value else 1
    text = format_number(value, f",.{max(0, digits - before)}f")
    return text.rstrip("0").rstrip(".") if "." in text else text


def plural(count: float, noun: str) -> str:
    """Write a count of things: ``1 thread``, ``2,000 routes``, ``1.67 decisions``."""
    text = f"{count:,}" if isinstance(count, int) else format_significant(count)
    return f"{text} {noun}{'' if text == '1' else 's'}"


def join_names(names: Sequence[str], most: int = 5) -> str:
    """Write at most so many names, and how many more there are."""
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def format_duration(seconds: float) -> str:
    """Write a duration: ``40 s``, ``3 min``, ``2 h 5 min``."""
    if seconds < 90:
        return f"{max(seconds, seconds > 0):.0f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def with_prefix(name: str, text: str) -> str:
    """Put a name and a colon before a text that does not begin with them."""
    return text if text.startswith(f"{name}:") else f"{name}: {text}"


def error_line(error: BaseException) -> str:
    """Return an error's message, on one line of 200 characters at most, or its type."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def missing_note(reasons: Mapping[str, str]) -> str:
    """Return a table's note on what was not measured, empty without ``reasons``."""
    # Rows of one reason are named together
    names_by_reason = {reason: list[str]() for reason in reasons.values()}
    for name, reason in reasons.items():
        names_by_reason[reason].append(name.strip())
    parts = (f"{', '.join(names)} ({why})" for why, names in names_by_reason.items())
    return f"Not measured: {'; '.join(parts)}." if reasons else ""


def format_mb(count: float) -> str:
    """Write bytes in MB (1e6 bytes), to two decimals."""
    return f"{count / 1e6:.2f}"


def format_gmacs(macs: int | None, unknown: int | None = 0, form: str = ".2f") -> str:
    """Write MACs in billions, with ≥ where ``unknown`` nodes are not counted."""
    if macs is None:
        return "-"
    return ("≥ " if unknown else "") + format(macs / 1e9, form)


def escape_markdown(text: str) -> str:
    """Return a text on one line that Markdown shows as it is: no HTML, no columns."""
    lines = html.escape(escape_controls(text), quote=False).splitlines()
    return " ".join(lines).replace("|", "\\|")


def _escape_newlines(text: str) -> str:
    return escape_controls(text).replace("\n", "\\n")


def _markdown_row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def cell_text(cell: Cell) -> str:
    """Write a cell on one line, its interval in brackets."""
    return f"{cell.text} ({cell.detail})" if cell.detail else cell.text
