"""The ``me2e-compress`` command, one short file each; the only room that prints."""


def main() -> int:
    """Run the command and give its exit code.

    The commands are imported here, not above: the processes that ``evaluate`` spawns
    import this module again, and need none of them.
    """
    from me2e_compress.cli.app import run

    return run()
