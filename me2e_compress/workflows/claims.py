"""Outputs are claimed before any work: one writer at a time, no file of the user lost.

One rule for every command: what exists is replaced only if me2e-compress wrote it and
nobody touched it since, unless forced. The record, :data:`RECORD`, lies in the folder
of the outputs: their names, and size and time of each as it was left. While a command
writes, it holds a lock on that record, which the system takes from a process that dies.
"""

import contextlib
import errno
import fcntl
import json
import os
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

from me2e_compress import documents
from me2e_compress.errors import GraphError
from me2e_compress.workflows.checks import Given, check_output

RECORD = ".me2e-compress.json"

State: TypeAlias = list[list[str | int]] | None
"""Name, bytes and nanoseconds of a file, or of all files of a folder; None: missing."""

_UNLOCKABLE = (errno.ENOLCK, errno.ENOTSUP, errno.EINVAL)
"""What a file system says that has no locks: then nothing is locked."""


@contextlib.contextmanager
def writing(
    files: Sequence[Path | None] = (),
    inputs: Iterable[Given] = (),
    *,
    trees: Sequence[Path] = (),
    folders: Sequence[Path] = (),
    force: bool = False,
) -> Iterator[None]:
    """Claim outputs while they are written.

    Args:
        files: that are written.
        inputs: files and folders that are read, and so not to be written.
        trees: folders that are written anew as a whole.
        folders: that one command at a time may work in; what is in them is its own
            affair.
        force: replace files and trees of the user too.

    Raises:
        GraphError: an output is the user's, an input, no regular file, or another
            process writes it.
    """
    check_output(files, inputs)
    outputs = [*filter(None, files), *trees]
    with contextlib.ExitStack() as stack:
        for folder in folders:
            place = _place_of(folder)
            if place.parent.is_dir():
                stack.enter_context(_opened(place)).lock(folder.resolve().name, folder)
        for output in outputs:
            if output.absolute().parent.is_dir():
                stack.enter_context(_claim(output, force=force))
        yield


def check_ours(files: Iterable[Path], *, force: bool = False) -> None:
    """Refuse, long before they are written, files that are not to be replaced.

    Raises:
        GraphError: one is the user's, no regular file, or another process writes it.
    """
    with writing([file for file in files if file.parent.is_dir()], force=force):
        return


def _place_of(folder: Path) -> Path:
    """Return the record that says who works in a folder: beside it, if that may be."""
    above = folder.resolve().parent
    return (above if os.access(above, os.W_OK) else folder) / RECORD


@contextlib.contextmanager
def _claim(output: Path, *, force: bool) -> Iterator[None]:
    """Lock one output, and write down how it was left."""
    with _opened(output.absolute().parent / RECORD) as record:
        record.lock(output.name, output)
        before = _state(output)
        record.check(output, before, force=force)
        record.note(output.name, writing=before)
        try:
            yield
        finally:
            after = _state(output)
            kept = record.earlier if after == before else after
            record.note(output.name, left=kept)


class _Record:
    """The record of one folder, open and locked by parts.

    Args:
        path: of the file.
        handle: of the open file.
    """

    def __init__(self, path: Path, handle: int) -> None:
        self.path, self.handle = path, handle
        self.earlier: State = None

    def lock(self, name: str, output: Path) -> None:
        """Take the lock of one output.

        Raises:
            GraphError: another process has it.
        """
        place = 1 + zlib.crc32(name.encode("utf-8", "surrogateescape"))
        if not _try_lock(self.handle, 1, place):
            raise GraphError(
                f"{output} is in use: another me2e-compress writes there; wait for it,"
                " or choose another name"
            )
        if not _is_at(self.handle, self.path):  # removed while we waited
            os.close(self.handle)
            self.handle = _handle(self.path)
            self.lock(name, output)

    def check(self, output: Path, found: State, *, force: bool) -> None:
        """Refuse an output that is there and not as we left it."""
        entry = self._read().get(output.name)
        known = entry if isinstance(entry, dict) else {}
        self.earlier = known.get("left")
        if found is None or found == [] or force:
            return
        if "writing" in known:  # a run that was killed
            return
        if found != self.earlier:
            raise GraphError(
                f"{output} is there, and not as me2e-compress left it: choose another"
                " name, or replace it by --force"
            )

    def note(self, name: str, **state: State) -> None:
        """Write what is known of one output; of a missing one, nothing."""
        with _locked(self.handle):
            entries = self._read()
            entries.pop(name, None)
            if "writing" in state or state.get("left"):
                entries[name] = state
            self._write(entries)

    def _read(self) -> dict[str, object]:
        try:
            found = documents.from_json(os.pread(self.handle, 1 << 26, 0))
        except documents.MalformedError:  # new, or cut by a kill
            return {}
        return found if isinstance(found, dict) else {}

    def _write(self, entries: dict[str, object]) -> None:
        text = json.dumps(entries, indent=1, sort_keys=True).encode() + b"\n"
        os.ftruncate(self.handle, 0)
        os.pwrite(self.handle, text, 0)

    def close(self) -> None:
        """Close it, and remove it if it says nothing and nobody else has a lock."""
        if not self._read() and _try_lock(self.handle, 0, 0):
            self.path.unlink(missing_ok=True)
        os.close(self.handle)


_OPEN: dict[Path, tuple[_Record, int]] = {}
"""Records that this process has open, and how often: closing any handle of a file
would drop all its locks."""


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[_Record]:
    """Open a record, or share the one that is open; what says nothing is removed."""
    path = path.parent.resolve() / path.name
    record, users = _OPEN.get(path) or (_Record(path, _handle(path)), 0)
    _OPEN[path] = record, users + 1
    try:
        yield record
    finally:
        record, users = _OPEN.pop(path)
        if users > 1:
            _OPEN[path] = record, users - 1
        else:
            record.close()


def _handle(path: Path) -> int:
    """Open the file; again, if another process removed it meanwhile."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        if _is_at(handle, path):
            return handle
        os.close(handle)


def _is_at(handle: int, path: Path) -> bool:
    """Return whether an open file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def _try_lock(handle: int, length: int, place: int) -> bool:
    """Take a lock without waiting; a file system without locks grants every one."""
    try:
        fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB, length, place)
    except OSError as error:
        return error.errno in _UNLOCKABLE
    return True


@contextlib.contextmanager
def _locked(handle: int) -> Iterator[None]:
    """Hold the lock on what a record says."""
    try:
        fcntl.lockf(handle, fcntl.LOCK_EX, 1, 0)
    except OSError as error:
        if error.errno not in _UNLOCKABLE:
            raise
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.lockf(handle, fcntl.LOCK_UN, 1, 0)


def _state(output: Path) -> State:
    """Return size and time of a file, or of every file of a folder."""
    if not os.path.lexists(output):
        return None
    if not output.is_dir():
        return [_signature(output, output.name)]
    files = (file for file in sorted(output.rglob("*")) if not file.is_dir())
    return [_signature(file, str(file.relative_to(output))) for file in files]


def _signature(file: Path, name: str) -> list[str | int]:
    about = file.lstat()
    return [name, about.st_size, about.st_mtime_ns]
