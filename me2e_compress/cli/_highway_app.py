"""The closed-loop commands alone."""

import sys

import typer
from rich.markup import escape

from me2e_compress.cli.console import errors
from me2e_compress.cli.evaluate import evaluate
from me2e_compress.cli.profile import profile
from me2e_compress.cli.score import score
from me2e_compress.errors import Me2eError

app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
for command in (evaluate, score, profile):
    app.command()(command)


def main() -> int:
    """Run the command; our own errors become one line and exit code 1."""
    try:
        app()
    except (Me2eError, OSError) as error:
        errors.print(f"me2e-compress: {escape(' '.join(str(error).split()))}")
        return 1
    except SystemExit as done:
        return done.code if isinstance(done.code, int) else 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
