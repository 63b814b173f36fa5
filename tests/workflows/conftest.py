"""The folders that commands are tested in."""

from tests.command import cli, command, dense, files

__all__ = ["cli", "command", "dense", "files"]
