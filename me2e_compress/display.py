"""Tables, and how numbers and counts are written in them."""

import html
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

AT_LEAST = "≥ or -: plugins and open shapes are not counted; inspect names them"
"""What a table says of MACs that are a lower bound."""

_UNSEEN = re.compile(
    "[\x00-\x09\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f"
    "\ud800-\udfff\ufeff\ufff9-\ufffb]"
)
"""Control characters but the end of a line, marks that turn the direction of writing,
and halves of characters: they steer a terminal, or no file can hold them."""


def printable(text: str) -> str:
    """Write what cannot be seen in a text, but ends of lines, as escapes."""
    return _UNSEEN.sub(
        lambda match: match.group().encode("unicode_escape").decode(), text
    )


@dataclass(frozen=True)
class Cell:
    """A number or words as shown, and its interval, if any, in smaller type.

    ``reason`` is why there is no number; empty if there is one.
    """

    text: str
    detail: str = ""
    reason: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of one thing each: the first columns are words, the others are numbers.

    Attributes:
        title: Heads it.
        columns: With their units.
        rows: As wide as the columns.
        note: What a reader must know; a few sentences, or a few lines.
        strong: Name of the row that the others are held against.
        words: How many of the first columns are words.
        details: Lines for who wants to know more; ``-v`` shows them.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    strong: str = ""
    words: int = 1
    details: str = ""

    def printable(self) -> "Table":
        """Return it with what cannot be seen as escapes; a name is on one line."""
        rows = (
            tuple(replace(each, text=_on_one_line(each.text)) for each in row)
            for row in self.rows
        )
        return replace(
            self,
            title=_on_one_line(self.title),
            rows=tuple(rows),
            note=printable(self.note),
            details=printable(self.details),
        )

    def markdown(self) -> str:
        """Write it as GitHub shows it, intervals in brackets, every name escaped."""
        rule = "|---|" + "---:|" * (len(self.columns) - 1)
        rows = [[in_markdown(in_words(cell)) for cell in row] for row in self.rows]
        lines = [_line(self.columns), rule, *map(_line, rows)]
        title = f"**{in_markdown(self.title)}**"
        parts = [title, "\n".join(lines), *filter(None, [in_markdown(self.note)])]
        return "\n\n".join(parts) + "\n"


def table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    note: str = "",
    words: int = 1,
    details: str = "",
) -> Table:
    """Build a table of plain texts."""
    cells = tuple(tuple(map(Cell, row)) for row in rows)
    return Table(title, tuple(columns), cells, note, words=words, details=details)


def number(value: float | None, form: str = ",.0f") -> str:
    """Write a number, or a dash for what was not measured; never a negative zero."""
    if value is None:
        return "-"
    sign = "+" if form.startswith("+") else ""
    return format(value, f"{sign}z{form.removeprefix('+')}")


def significant(value: float | None, digits: int = 4) -> str:
    """Write a number in so many digits, but no powers of ten: 4,778,000 and 0.00012.

    Digits before the point are all written, and no zeros at the end of the others.
    """
    if value is None or not math.isfinite(value):
        return number(value)
    before = math.floor(math.log10(abs(value))) + 1 if value else 1
    text = number(value, f",.{max(0, digits - before)}f")
    return text.rstrip("0").rstrip(".") if "." in text else text


def counted(count: float, noun: str) -> str:
    """Write how many there are: ``1 thread``, ``2,000 routes``, ``1.67 decisions``."""
    text = f"{count:,}" if isinstance(count, int) else significant(count)
    return f"{text} {noun}{'' if text == '1' else 's'}"


def some_of(names: Sequence[str], most: int = 5) -> str:
    """Write the first of many names, and how many more there are."""
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def duration(seconds: float) -> str:
    """Write a time as people say it: ``40 s``, ``3 min``, ``2 h 5 min``."""
    if seconds < 90:
        return f"{max(seconds, seconds > 0):.0f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def prefixed(name: str, text: str) -> str:
    """Write who says something before it, once."""
    return text if text.startswith(f"{name}:") else f"{name}: {text}"


def reason(error: BaseException) -> str:
    """Write on one line why something failed; its kind where it says no more."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def not_measured(reasons: Mapping[str, str]) -> str:
    """Write why things have no number, for the note of their table; empty if all have.

    ``reasons`` are by the name of the row.
    """
    rows = {why: list[str]() for why in reasons.values()}
    for name, why in reasons.items():
        rows[why].append(name.strip())
    reasons_of = (f"{', '.join(names)} ({why})" for why, names in rows.items())
    return f"Not measured: {'; '.join(reasons_of)}." if reasons else ""


def megabytes(count: float) -> str:
    """Write bytes as MB (1e6)."""
    return f"{count / 1e6:.2f}"


def giga(macs: int | None, unknown: int | None = 0, form: str = ".2f") -> str:
    """Write MACs in billions, as a lower bound where those of some nodes are unknown.

    ``macs`` is None if none are known.
    """
    if macs is None:
        return "-"
    return ("≥ " if unknown else "") + format(macs / 1e9, form)


def in_markdown(text: str) -> str:
    """Write a text so that Markdown shows it as it is: no HTML, no columns."""
    lines = html.escape(printable(text), quote=False).splitlines()
    return " ".join(lines).replace("|", "\\|")


def _on_one_line(text: str) -> str:
    return printable(text).replace("\n", "\\n")


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def in_words(cell: Cell) -> str:
    """Write a cell on one line, its interval in brackets."""
    return f"{cell.text} ({cell.detail})" if cell.detail else cell.text
