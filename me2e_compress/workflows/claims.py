"""Check outputs before any work: no user file is lost, one run works in a folder.

One rule holds for every command: an existing file is replaced only if it says that
me2e-compress wrote it (:mod:`me2e_compress.registry.drafts`), unless forced. A command
that works in a folder which later runs resume holds a lock on that folder. The system
releases it when the process dies, and nothing of it lies in the folder.
"""

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from me2e_compress.errors import GraphError
from me2e_compress.registry.drafts import is_marked
from me2e_compress.shipped import drivers as shipped
from me2e_compress.workflows.checks import Given, check_output


@contextlib.contextmanager
def writing(
    files: Sequence[Path | None] = (),
    inputs: Iterable[Given] = (),
    *,
    trees: Sequence[Path] = (),
    folders: Sequence[Path] = (),
    force: bool = False,
) -> Iterator[None]:
    """Check outputs, and hold the folders to work in, while they are written.

    Args:
        files: files that are written.
        inputs: files and folders that are read, and must not be overwritten.
        trees: folders that are replaced as a whole.
        folders: folders that one command at a time may work in; they are made if
            needed, and their contents are not checked.
        force: replace files and trees of the user too.

    Raises:
        GraphError: An output belongs to the user, is an input or no regular file, or
            another process works in one of the folders.
    """
    check_output(files, inputs)
    check_ours(filter(None, files), trees=trees, force=force)
    with contextlib.ExitStack() as stack:
        for folder in folders:
            stack.enter_context(_alone_in(folder))
        yield


def check_ours(
    files: Iterable[Path], *, trees: Iterable[Path] = (), force: bool = False
) -> None:
    """Refuse early what :func:`writing` would refuse."""
    there = [file for file in files if file.parent.is_dir()]
    check_output(there, ())
    for output in (*there, *trees):
        if os.path.lexists(output) and not force and not is_ours(output):
            raise GraphError(
                f"{output} is there, and me2e-compress did not write it: choose another"
                " name, or replace it by --force"
            )


def is_ours(path: Path) -> bool:
    """Return whether nothing of the user is lost if a file or folder is replaced."""
    return is_marked(path) or (not path.is_symlink() and shipped.is_copy(path))


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold a folder; another process that would do so is refused."""
    is_new = not folder.is_dir()
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        if not _try_lock(handle):
            raise GraphError(
                f"{folder} is in use: another me2e-compress works there; wait for it,"
                " or choose another folder"
            )
        try:
            yield
        finally:
            if is_new:
                with contextlib.suppress(OSError):  # what is not empty stays
                    folder.rmdir()
    finally:
        os.close(handle)


def _try_lock(handle: int) -> bool:
    """Take a lock without waiting; file systems without locks grant every one."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EWOULDBLOCK, errno.EAGAIN)
    return True
