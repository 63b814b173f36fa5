"""Train the driver from nothing.

    python -m models.driver.train -o FOLDER [--seed N] [--overlook SHARE]
                           [--workers N] [--small]

The same command again goes on where it was interrupted.
"""

import sys

from me2e_compress.base.errors import OptionError
from me2e_compress.base.extras import require_extra
from me2e_compress.cli import RUN_AGAIN, run_command
from me2e_compress.cli.app import build_app
from me2e_compress.cli.commands import Output
from me2e_compress.cli.console import listening, show


def command(
    *,
    output: Output,
    workers: int = 4,
    small: bool = False,
    seed: int = 0,
    overlook: float | None = None,
) -> None:
    """Train the driver from nothing: collect, learn, drive, learn again (hours).

    Args:
        output: the folder; the same again resumes
        workers: processes at a time
        small: every part, a minute, learns nothing
        seed: of the first weights, not of the routes
        overlook: share of agents the planner is not told of: only occupancy shows them
    """
    if not 0.0 <= (overlook or 0.0) <= 1.0:
        raise OptionError(f"--overlook is {overlook}: it must be from 0 to 1")
    require_extra("highway", "training")
    from models.driver.workflow import train  # takes torch seconds to import

    with listening(stages=True) as listener:
        found = train(
            output,
            workers,
            listener,
            small=small,
            seed=seed,
            overlook=overlook,
        )
    show(found)


def main() -> int:
    """Run the command, with one line for an error, as ``me2e-compress`` does."""
    app = build_app("python -m models.driver.train")
    app.default(command)
    return run_command(lambda: app.meta(sys.argv[1:]), RUN_AGAIN)


if __name__ == "__main__":
    sys.exit(main())
