"""A finished draft takes its place in one step; who claims the place hears of it first.

Between a rename and the note of it a process can be killed. What is about to stand in
a place is therefore told before: a later run knows it again, whichever came last.
"""

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

_CLAIMED: dict[Path, Callable[[Path], None]] = {}
"""Who is told of a draft before it is put in a place."""


@contextlib.contextmanager
def announced(path: Path, told: Callable[[Path], None]) -> Iterator[None]:
    """Be told of every draft just before it takes a place.

    Args:
        path: the place.
        told: is called with the draft.
    """
    place = _place(path)
    before = _CLAIMED.get(place)
    _CLAIMED[place] = told
    try:
        yield
    finally:
        del _CLAIMED[place]
        if before is not None:
            _CLAIMED[place] = before


def put(draft: Path, path: Path) -> None:
    """Put a draft in its place; of folders, the earlier one is removed.

    Args:
        draft: in the file system of its place.
        path: the place.

    Raises:
        OSError: it cannot be put there.
    """
    if (told := _CLAIMED.get(_place(path))) is not None:
        told(draft)
    if not draft.is_dir():
        os.replace(draft, path)
        return
    aside = draft.with_name(f"{draft.name}.before")
    shutil.rmtree(aside, ignore_errors=True)
    if path.exists():  # a folder is renamed at once, and removed file by file
        os.replace(path, aside)
    os.replace(draft, path)
    shutil.rmtree(aside, ignore_errors=True)


def _place(path: Path) -> Path:
    return path.absolute().parent.resolve() / path.name
