"""``me2e-compress study``."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table as Shown

from me2e_compress.cli.console import console, errors, print_json, progress, table
from me2e_compress.cli.models import model_path
from me2e_compress.cli.output import Given, check_folder, files_of
from me2e_compress.evaluators.highway.evaluation_options import engine_of
from me2e_compress.study import Listener, Study, load_study, run_study
from me2e_compress.study.cells import Cell, Table
from me2e_compress.study.tables import all_tables
from me2e_compress.study.write import HTML, JSON, MARKDOWN, write

WIDE = 120
"""Columns that a terminal must have for intervals beside the numbers."""


def study(
    definition: Annotated[Path, typer.Argument(help="STUDY.toml")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the folder")],
    routes: Annotated[
        str | None, typer.Option(help="instead of the study's: all, N, ID,ID")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="routes at a time")] = 1,
    engine: Annotated[str, typer.Option(help="local or ray")] = "local",
    address: Annotated[str | None, typer.Option(help="of a Ray cluster")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Drive schemes under conditions and compare them; run it again to go on."""
    ours = partial(model_path, beside=definition.parent)
    asked = load_study(definition, ours, routes)
    check_folder(output, _read(definition, asked), (JSON, MARKDOWN, HTML))
    with listener() as told:
        found = run_study(asked, output, engine_of(engine, workers, address), told)
    written = write(found, output, _words(definition, output, routes))
    if as_json:
        print_json(found.to_json())
        return
    for each in all_tables(found):
        console.print(shown(each))
    console.print(f"{written.report}, {written.tables} and {written.record} are yours.")


def _read(definition: Path, asked: Study) -> Iterator[Given]:
    """Give the files and folders that a study reads."""
    yield from (definition, asked.frames, asked.held_out)
    for each in asked.schemes:
        yield from (each.policy, each.module_map, each.adapter, each.trace)
        yield from files_of(each.passes)


def _words(definition: Path, output: Path, routes: str | None) -> tuple[str, ...]:
    chosen = () if routes is None else ("--routes", routes)
    return ("me2e-compress", "study", str(definition), "-o", str(output), *chosen)


@contextmanager
def listener() -> Iterator[Listener]:
    """Show a study's stages in one bar, and its surprises on stderr."""
    with progress("study") as advance:

        def on_progress(stage: str, done: int, total: int, words: str) -> None:
            advance(done, total, f"{stage}  {words}")

        yield Listener(
            on_progress,
            lambda line: errors.print(f"warning: {escape(line)}", soft_wrap=True),
        )


def shown(content: Table) -> Shown:
    """Show a study's table on the terminal, with its intervals if it is wide enough."""
    made = table(content.title, *content.columns)
    made.columns[0].no_wrap = True
    wide = console.width >= WIDE
    made.show_edge = made.pad_edge = wide  # four characters that numbers can use
    for row in content.rows:
        made.add_row(*(_text(cell, wide) for cell in row))
    made.caption, made.caption_justify = content.note, "left"
    return made


def _text(cell: Cell, wide: bool) -> str:
    if not (cell.detail and wide):
        return cell.text
    return f"{cell.text}\n[dim]{cell.detail}[/dim]"
