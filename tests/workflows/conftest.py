"""The folders that commands are tested in."""

from tests.cli.conftest import command, dense, files

__all__ = ["command", "dense", "files"]
