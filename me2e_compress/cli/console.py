"""What is printed, and how: results, tables, progress, JSON; ``-q``, ``-v``."""

import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Literal

from rich import progress
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from me2e_compress.base.display import (
    Cell,
    Table,
    escape_controls,
    format_duration,
    plural,
)
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.commands.result import Result

console = Console(record=True, emoji=False)
errors = Console(stderr=True, highlight=False, emoji=False)


@dataclasses.dataclass
class Printing:
    """What a run prints besides results and errors, and whether those are JSON."""

    quiet: bool = False
    verbose: bool = False
    json: bool = False


printing = Printing()  # of the run at hand: the command sets it
WIDE = 120  # columns that a terminal must have for intervals beside the numbers


@contextmanager
def listening(*, stages: bool = False) -> Iterator[Listener]:
    """Yield a listener that shows progress and warnings on stderr; nothing if quiet.

    A terminal has a bar, a log a line now and then, and for every stage if asked.
    """
    if printing.quiet:
        yield SILENT
        return
    # A log gets lines, since it cannot show a bar
    if not errors.is_terminal:
        yield Listener(ProgressLines(tell, stages=stages).on_progress, _warn)
        return
    # a terminal shows one bar, which starts again with every stage
    bar = progress.Progress(
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(bar_width=20),
        progress.TextColumn("{task.fields[what]}", markup=False),
        progress.TimeElapsedColumn(),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(),
        console=errors,
        transient=True,
    )
    with bar:
        task, shown = bar.add_task("", total=1, what=""), ""

        def on_progress(stage: str, done: int, total: int, what: str) -> None:
            nonlocal shown
            if stage != shown:
                bar.reset(task)
            shown = stage
            text = _progress_text(done, total, what)
            bar.update(task, description=stage, completed=done, total=total, what=text)

        yield Listener(on_progress, _warn)


def _progress_text(done: int, total: int, what: str) -> str:
    """Write how much is done; a total of 0 is not known."""
    return f"{done}/{total} {what}".rstrip() if total else f"{done} {what}".rstrip()


def _warn(line: str) -> None:
    tell(f"warning: {line}")


def tell(line: str) -> None:
    """Print a line on stderr without markup; nothing if quiet."""
    if not printing.quiet:
        errors.print(escape_controls(line), soft_wrap=True, markup=False)


def show(result: Result, tables: Iterable[Table] | None = None) -> None:
    """Print tables, the result's own or others, then lines and alerts; or JSON."""
    if printing.json:
        print_json(result.document())
        return
    # tables first, so that the verdict stays in sight at the end
    for table in result.tables() if tables is None else tables:
        print_table(table)
    for line in result.lines():
        say(line)
    for line in result.alerts():
        console.print(Text(escape_controls(line), "bold"), soft_wrap=True)


def show_call(workflow: Callable[..., Result], *words: object) -> None:
    """Call a workflow with a listener, show its result, and raise if it is refused."""
    with listening() as listener:
        result = workflow(*words, listener)
    show(result)
    result.check()


def say(line: str) -> None:
    """Print a line without markup."""
    console.print(escape_controls(line), soft_wrap=True, markup=False)


def print_table(content: Table) -> None:
    """Print a table and its note; in a narrow terminal a row becomes a few lines."""
    # Intervals are shown if the terminal is wide, or the table narrow
    content, wide = content.escape_controls(), console.width >= WIDE
    count = len(content.columns)
    spare = console.width - (3 * count + 1 if wide else 3 * (count - 1))  # of rules
    intervals = wide or sum(_lengths(content, True, str.splitlines)) <= spare
    least = _lengths(content, intervals, str.split)
    fits = sum(least) <= spare
    console.print(Text(content.title, "bold"), soft_wrap=True)
    # Columns side by side, none of their words broken
    if fits:
        # Spare characters go to narrow columns first: only long sentences wrap
        most = _lengths(content, intervals, str.splitlines)
        wanted = [high - low for low, high in zip(least, most, strict=True)]
        spare -= sum(least)
        for done, at in enumerate(sorted(range(count), key=wanted.__getitem__)):
            extra = min(wanted[at], spare // (count - done))
            least[at], spare = least[at] + extra, spare - extra
        grid = RichTable()
        grid.show_edge = grid.pad_edge = wide  # four characters that numbers can use
        for at, (name, width) in enumerate(zip(content.columns, least, strict=True)):
            side: Literal["left", "right"] = "left" if at < content.words else "right"
            grid.add_column(Text(name), justify=side, overflow="fold", width=width)
        for row in content.rows:
            grid.add_row(*(_rich_text(cell, intervals) for cell in row))
        console.print(grid)
    # Each row as its name and, indented, its other cells
    for first, *others in () if fits else content.rows:
        console.print(Text(first.text), soft_wrap=True)
        for name, cell in zip(content.columns[1:], others, strict=True):
            if cell.text:
                label = f"{name}: " if name and count > 2 else ""
                console.print(Text(f"    {label}{cell.text}"), soft_wrap=True)
    # Notes on what the table leaves out
    if content.note:
        console.print(Text(content.note, "dim"))
    if not intervals and any(cell.detail for row in content.rows for cell in row):
        console.print(Text(f"Intervals: in a terminal of {WIDE} columns.", "dim"))
    if content.details:
        lines = plural(content.details.count("\n") + 1, "note")
        shown = content.details if printing.verbose else f"{lines} more: -v"
        console.print(Text(shown, "dim"), soft_wrap=True)


def _lengths(
    content: Table, intervals: bool, parts: Callable[[str], list[str]]
) -> list[int]:
    """Return the length of the longest part, a word or a line, of every column."""
    lengths = list[int]()
    for at, name in enumerate(content.columns):
        texts = [_rich_text(row[at], intervals).plain for row in content.rows]
        words = (part for text in (name, *texts) for part in parts(text))
        lengths.append(max(map(len, words), default=1))
    return lengths


def _rich_text(cell: Cell, intervals: bool) -> Text:
    if cell.detail and intervals:
        return Text.assemble(cell.text, "\n", (cell.detail, "dim"))
    return Text(cell.text)


def print_json(data: object) -> None:
    """Print one JSON document on stdout."""
    sys.stdout.write(json.dumps(data, indent=2, allow_nan=False) + "\n")


EVERY_S = 10.0  # seconds between two lines


class ProgressLines:
    """Writes progress to a log every `EVERY_S`, and at the end of a stage it shows."""

    def __init__(
        self,
        write: Callable[[str], None],
        *,
        stages: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._write, self._stages, self._clock = write, stages, clock
        self._stage, self._unfinished = "", False
        self._begun_s = self._last_s = clock()

    def on_progress(self, stage: str, done: int, total: int, what: str) -> None:
        """Write a line if it is time for one; to be called by a listener."""
        now = self._clock()
        if stage != self._stage:
            self._stage, self._begun_s, self._unfinished = stage, now, False
            if self._stages:
                self._write(stage)
                self._last_s = now
        if now - self._last_s < EVERY_S and not (self._unfinished and done == total):
            return
        self._last_s, self._unfinished = now, done < total
        line = f"{stage}: {_progress_text(done, total, what)}"
        # how long the rest takes at the pace so far
        if 0 < done < total:
            left = (now - self._begun_s) / done * (total - done)
            line += f", {format_duration(left)} left"
        self._write(line)
