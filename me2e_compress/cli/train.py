"""``me2e-compress train``."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from me2e_compress.cli.console import console, errors
from me2e_compress.errors import MissingExtraError


def train(
    stack: Annotated[Literal["highway"], typer.Argument(help="highway")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="a folder; the same again resumes")
    ],
    workers: Annotated[int, typer.Option(min=1, help="processes")] = 4,
    small: Annotated[
        bool, typer.Option("--small", help="every part, a minute, learns nothing")
    ] = False,
) -> None:
    """Train the driver from nothing: collect, learn, drive, learn again (hours)."""
    try:
        from me2e_compress.zoo.train.course import FULL, SMALL, News, run
    except ModuleNotFoundError as error:
        raise MissingExtraError(error.name or "torch", "zoo,highway") from error
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=errors) as bar:
        task = bar.add_task("")

        def tell(news: News) -> None:
            bar.update(
                task, description=news.what, completed=news.done, total=news.total
            )

        driver = run(SMALL if small else FULL, output, workers, tell)
    console.print(f"{driver} drives; its log is {driver.parent / 'training'}")
