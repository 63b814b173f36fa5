"""The ``me2e-compress`` command, one short file each; the only room that prints."""

from me2e_compress.errors import Me2eError


def main() -> int:
    """Run the command and give its exit code; our own errors are one line and code 1.

    The commands are imported here, not above: the processes that ``evaluate`` spawns
    import this module again, and need none of them.
    """
    from rich.markup import escape

    from me2e_compress.cli.app import app
    from me2e_compress.cli.console import errors
    from me2e_compress.cli.verbosity import Verbosity, set_verbosity

    set_verbosity(Verbosity.NORMAL)
    try:
        app(standalone_mode=True, prog_name="me2e-compress")
    except (Me2eError, OSError) as error:
        line = " ".join(str(error).split())
        errors.print(f"me2e-compress: {escape(line)}", soft_wrap=True)
        return 1
    except SystemExit as done:
        return done.code if isinstance(done.code, int) else int(bool(done.code))
    except KeyboardInterrupt:
        errors.print("me2e-compress: interrupted")
        return 130
    return 0
