"""``me2e-compress demo``."""

import time
from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, say, show
from me2e_compress.cli.verbosity import is_json, is_verbose
from me2e_compress.extras import need_extra
from me2e_compress.workflows.demo_result import DemoResult, figure
from me2e_compress.workflows.result import Result

Output = Annotated[
    Path, typer.Option("-o", "--output", "--out", help="the folder to write")
]


def demo(
    output: Output = Path("out"),
    force: given.Force = False,
) -> None:
    """Run the main job on what ships: compress, verify, compare, drive, report.

    The trained driver is compressed and drives before and after.
    """
    need_extra("highway", "driving in the demo")
    from me2e_compress.study.demo import DriverDemo

    steps = DriverDemo(output, force).steps
    # each step says what it found as soon as it is done
    output.mkdir(parents=True, exist_ok=True)
    found = dict[str, Result]()
    for name, step in steps.items():
        begun = time.monotonic()
        with listening() as listener:
            found[name] = step(listener)
        if not is_json():
            seconds = time.monotonic() - begun
            say(f"{name:<10}{seconds:4.0f} s   {figure(found[name])}")
            if is_verbose():
                show(found[name])
    # with -v every step was shown in full already
    whole = DemoResult(found)
    if is_json() or not is_verbose():
        show(whole)
