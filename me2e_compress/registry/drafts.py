"""A finished draft takes its place in one step, and several places change as a set."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

_SETS: list[list[tuple[Path, Path]]] = []
"""Of each open block: the places where something was put, and what was there."""


def put(draft: Path, path: Path) -> None:
    """Put a draft in its place, which is in the same file system.

    Of folders, the earlier one is removed.
    """
    if not draft.is_dir():
        _keep(path)
        os.replace(draft, path)
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    if path.exists():  # a folder is renamed at once, and removed file by file
        os.replace(path, aside)
    os.replace(draft, path)
    shutil.rmtree(aside, ignore_errors=True)


def remove(path: Path) -> None:
    """Remove a file that a draft took the place of, if it is there."""
    _keep(path)
    path.unlink(missing_ok=True)


@contextlib.contextmanager
def all_or_none() -> Iterator[None]:
    """Take back the files that are put or removed in this block if an error leaves it.

    What was there before is kept until its end, as a second link to the same file.
    """
    kept: list[tuple[Path, Path]] = []
    _SETS.append(kept)
    try:
        yield
    except BaseException:
        for path, before in reversed(kept):
            if os.path.lexists(before):
                os.replace(before, path)
            else:
                path.unlink(missing_ok=True)
        raise
    finally:
        _SETS.pop()
        for _, before in kept:
            shutil.rmtree(before.parent, ignore_errors=True)


def _keep(path: Path) -> None:
    """Keep what is in a place, if what happens there may be taken back."""
    if not _SETS:
        return
    before = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent), path.name)
    _SETS[-1].append((path, before))
    if os.path.lexists(path):
        try:
            os.link(path, before, follow_symlinks=False)
        except OSError:  # a file system without links
            shutil.copy2(path, before, follow_symlinks=False)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let errors of the system name a file, not the draft of it, or nothing."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextlib.contextmanager
def written(path: Path, error: Callable[[str], Exception]) -> Iterator[None]:
    """Turn the system's refusal to write a file here into one line that names it."""
    try:
        yield
    except OSError as cause:
        raise error(f"{path}: cannot be written: {cause.strerror}") from cause
