"""What every command prints with."""

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from me2e_compress.graph import file_bytes as file_bytes

console = Console(record=True)
errors = Console(stderr=True, highlight=False)

Advance = Callable[[int, int, str], None]


@contextmanager
def progress(title: str) -> Iterator[Advance]:
    """Show a bar on stderr; the value is called with done, total and what is done."""
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
        task = bar.add_task(title, total=1, what="")

        def advance(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total, what=what)

        yield advance


def table(title: str, *columns: str, left: int = 1) -> Table:
    """Make a table whose first ``left`` columns are words and the rest numbers."""
    made = Table(title=title, title_justify="left", title_style="bold")
    for at, name in enumerate(columns):
        side: Literal["left", "right"] = "left" if at < left else "right"
        made.add_column(name, justify=side, overflow="fold")
    return made


def print_json(data: object) -> None:
    """Print one JSON document on stdout; what is no finite number is null."""
    sys.stdout.write(json.dumps(_plain(data), indent=2, allow_nan=False) + "\n")


def megabytes(count: float) -> str:
    """Write bytes as MB (1e6)."""
    return f"{count / 1e6:.2f}"


def number(value: float | None, form: str = ",.0f") -> str:
    """Write a number, or a dash for what was not measured."""
    return "-" if value is None else format(value, form)


def _plain(value: object) -> object:
    """Give data as JSON knows it: no dataclasses, paths, NaN, infinities."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
