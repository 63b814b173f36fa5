"""The folders that commands are tested in."""

from tests.command import command, dense, files

__all__ = ["command", "dense", "files"]
