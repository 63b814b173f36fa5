"""``me2e-compress train``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.extras import need_extra

Stack = Annotated[Literal["highway"], typer.Argument(help="highway")]
Output = Annotated[
    Path, typer.Option("-o", "--output", help="the folder; the same again resumes")
]
Small = Annotated[
    bool, typer.Option("--small", help="every part, a minute, learns nothing")
]


def train(
    stack: Stack,
    output: Output,
    workers: given.Workers = 4,
    small: Small = False,
    as_json: given.Json = False,
) -> None:
    """Train the driver from nothing: collect, learn, drive, learn again (hours)."""
    need_extra("zoo,highway", "training")
    # takes torch seconds to import
    from me2e_compress.workflows import train as workflow

    with listening(stages=True) as listener:
        options = workflow.TrainOptions(workers, small)
        found = workflow.train(output, options, listener)
    show(found, as_json)
