"""``me2e-compress train``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.markup import escape

from me2e_compress.cli.console import console, errors, number, progress, table
from me2e_compress.cli.output import check_folder
from me2e_compress.metrics.measure import Estimate

if TYPE_CHECKING:
    from me2e_compress.training.course import CourseProgress


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
    # takes torch seconds to import
    from me2e_compress.training.course import NO_LATENCY, run
    from me2e_compress.training.curriculum import FULL, SMALL, SMALL_LATENCY

    check_folder(output, ())
    told = ""
    with progress("train") as advance:

        def tell(news: "CourseProgress") -> None:
            nonlocal told
            if news.what != told and not errors.is_terminal:
                errors.print(news.what)  # a log wants lines, not a bar
            told = news.what
            advance(news.done, news.total, news.what)

        course, latency = (SMALL, SMALL_LATENCY) if small else (FULL, NO_LATENCY)
        rounds = run(course, output, workers, tell, latency)
    columns = ("round", "routes", "driving score, %", "success rate, %")
    shown = table("driven on fresh routes after every round", *columns)
    for which, each in enumerate(rounds):
        found = (each.scores.driving_score, each.scores.success_rate)
        shown.add_row(str(which), str(each.scores.routes), *map(_between, found))
    console.print(shown)
    console.print(f"wrote {escape(str(rounds[-1].driver))}", soft_wrap=True)
    console.print(f"its log is {escape(str(rounds[-1].log))}", soft_wrap=True)


def _between(estimate: Estimate) -> str:
    ends = f"{number(estimate.low, '.1f')} to {number(estimate.high, '.1f')}"
    return f"{number(estimate.value, '.1f')} ({ends})"
