"""What every command prints with."""

import dataclasses
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table as Shown
from rich.text import Text

from me2e_compress.workflows.listener import Listener
from me2e_compress.workflows.result import Cell, Result, Table

console = Console(record=True)
errors = Console(stderr=True, highlight=False)

WIDE = 120
"""Columns that a terminal must have for intervals beside the numbers."""


@contextmanager
def listening(*, stages: bool = False) -> Iterator[Listener]:
    """Show progress in a bar on stderr, and warnings as lines there.

    Args:
        stages: where there is no terminal, print every new stage as a line.
    """
    shown = ""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} {task.fields[what]}"),
        TimeElapsedColumn(),
        console=errors,
        transient=True,
        disable=not errors.is_terminal,  # a log wants no bar
    )
    with bar:
        task = bar.add_task("", total=1, what="")

        def on_progress(stage: str, done: int, total: int, what: str) -> None:
            nonlocal shown
            if stages and stage != shown and not errors.is_terminal:
                errors.print(stage)
            shown = stage
            bar.update(task, description=stage, completed=done, total=total, what=what)

        yield Listener(on_progress, lambda line: tell(f"warning: {line}"))


def tell(line: str) -> None:
    """Print a line on stderr, as it stands."""
    errors.print(escape(line), soft_wrap=True)


def show(
    found: Result, as_json: bool = False, tables: Sequence[Table] | None = None
) -> None:
    """Print a result: its tables and lines, or one JSON document."""
    if as_json:
        print_json(found.to_json())
        return
    for each in found.tables() if tables is None else tables:
        print_table(each)
    for line in found.lines():
        say(line)


def say(line: str) -> None:
    """Print a line as it stands."""
    console.print(escape(line), soft_wrap=True)


def table(title: str, *columns: str, left: int = 1) -> Shown:
    """Make a table whose first ``left`` columns are words and the rest numbers."""
    made = Shown(title=Text(title, "bold"), title_justify="left")
    made.show_edge = made.pad_edge = _is_wide()  # four characters that numbers can use
    for at, name in enumerate(columns):
        side: Literal["left", "right"] = "left" if at < left else "right"
        whole = at == 0 and left == 1
        made.add_column(Text(name), justify=side, overflow="fold", no_wrap=whole)
    return made


def print_table(content: Table) -> None:
    """Print a table, with intervals if the terminal is wide enough, and its note."""
    made = table(content.title, *content.columns, left=content.words)
    for row in content.rows:
        made.add_row(*(_text(cell, _is_wide()) for cell in row))
    console.print(made)
    if content.note:
        console.print(Text(content.note, "dim"))


def _is_wide() -> bool:
    return console.width >= WIDE


def _text(cell: Cell, wide: bool) -> Text:
    if cell.detail and wide:
        return Text.assemble(cell.text, "\n", (cell.detail, "dim"))
    return Text(cell.text)


def print_json(data: object) -> None:
    """Print one JSON document on stdout; what is not a finite number is null."""
    sys.stdout.write(json.dumps(_plain(data), indent=2, allow_nan=False) + "\n")


def _plain(value: object) -> object:
    """Turn data into what JSON knows: no dataclasses, paths, NaN, infinities."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
