"""Claim outputs before any work: one writer at a time, and no user file is lost.

One rule holds for every command: an existing file is replaced only if me2e-compress
wrote it and nobody has changed it since, unless forced. The record, :data:`RECORD`,
lies in the folder of the outputs and holds the name, size and time of each as we left
it. While a file is replaced, the record also holds those of its draft, so that the
state after a kill at any point is known. A command that writes holds a lock on the
record, which the system releases when the process dies.
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

from me2e_compress import documents, drafts
from me2e_compress.errors import GraphError
from me2e_compress.workflows.checks import Given, check_output, resolved

RECORD = ".me2e-compress.json"

State: TypeAlias = list[list[str | int]] | None
"""Name, bytes and nanoseconds of a file, or of all files of a folder; None: missing."""

_UNLOCKABLE = (errno.ENOLCK, errno.ENOTSUP, errno.EINVAL)
"""Error numbers of file systems without locks, on which nothing is locked."""


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
        files: files that are written.
        inputs: files and folders that are read, and must not be overwritten.
        trees: folders that are replaced as a whole.
        folders: folders that one command at a time may work in; contents are not
            checked.
        force: replace files and trees of the user too.

    Raises:
        GraphError: An output belongs to the user, is an input or no regular file, or
            another process is writing it.
    """
    check_output(files, inputs)
    outputs = [*filter(None, files), *trees]
    with contextlib.ExitStack() as stack:
        # working folders are only locked, against a second command
        for folder in folders:
            place = _place_of(folder)
            if place.parent.is_dir():
                stack.enter_context(_opened(place)).lock(resolved(folder).name, folder)
        # files and trees are also checked, and recorded when they are done
        for output in outputs:
            if output.absolute().parent.is_dir():
                stack.enter_context(_claim(output, force=force))
        yield


def check_ours(
    files: Iterable[Path], *, trees: Iterable[Path] = (), force: bool = False
) -> None:
    """Refuse early what :func:`writing` would refuse."""
    there = [file for file in files if file.parent.is_dir()]
    check_output(there, ())
    for file in (*there, *(tree for tree in trees if tree.parent.is_dir())):
        with _opened(file.absolute().parent / RECORD) as record:
            _Claim(record, file, force=force)


def _place_of(folder: Path) -> Path:
    """Return the record that locks a working folder: beside it if that is writable."""
    above = resolved(folder).parent
    return (above if os.access(above, os.W_OK) else folder) / RECORD


@contextlib.contextmanager
def _claim(output: Path, *, force: bool) -> Iterator[None]:
    with _opened(output.absolute().parent / RECORD) as record:
        claim = _Claim(record, output, force=force)
        with drafts.announced(output, claim.announce):
            try:
                yield
            finally:
                claim.settle()


class _Claim:
    """One output that only this process may write, or a GraphError."""

    def __init__(self, record: "_Record", output: Path, *, force: bool) -> None:
        record.lock(output.name, output)
        self._record, self._output = record, output
        self._found = _state(output)
        # the output is ours as we left it, or as the draft that a kill let through
        known = record.of(output.name)
        ours = self._found in (known.get("left"), known.get("next"))
        if self._found and not ours and not force:
            raise GraphError(
                f"{output} is there, and not as me2e-compress left it: choose another"
                " name, or replace it by --force"
            )
        self._left = self._found if ours else None
        self._next: State = None

    def announce(self, draft: Path) -> None:
        """Record the draft that is about to take the output's place."""
        if self._next is not None and _state(self._output) == self._next:
            self._left = self._next
        self._next = _state(draft, self._output.name)
        self._record.note(self._output.name, left=self._left, next=self._next)

    def settle(self) -> None:
        """Record the output as it is now; an untouched one keeps its known state."""
        now = _state(self._output)
        left = self._left if now == self._found else now
        self._record.note(self._output.name, left=left)


class _Record:
    """The record of one folder, kept open; outputs are locked by byte ranges of it."""

    def __init__(self, path: Path, handle: int) -> None:
        self.path, self.handle = path, handle

    def lock(self, name: str, output: Path) -> None:
        """Take the lock of one output; raise GraphError if another process has it."""
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

    def of(self, name: str) -> dict[str, object]:
        """Return what is known of one output."""
        with _locked(self.handle):
            entry = self._read().get(name)
        return entry if isinstance(entry, dict) else {}

    def note(self, name: str, **states: State) -> None:
        """Record the states of one output; a missing output is forgotten."""
        known = {key: state for key, state in states.items() if state}
        with drafts.naming(self.path), _locked(self.handle):
            entries = self._read()
            if known == entries.pop(name, {}):
                return
            self._write(entries | {name: known} if known else entries)

    def _read(self) -> dict[str, object]:
        """Return the last complete record: a kill may have cut one short."""
        text = os.pread(self.handle, 1 << 26, 0)
        for each in (text, *reversed(text.splitlines())):
            try:
                found = documents.from_json(each)
            except documents.MalformedError:
                continue
            if isinstance(found, dict):
                return found
        return {}

    def _write(self, entries: dict[str, object]) -> None:
        """Append the new record, copy it to the front, then cut the file to it.

        The file is never replaced, because the locks are on it. The appended copy
        begins behind both the old record and the new one's place at the front, so that
        a complete record is in the file at any time.
        """
        line = json.dumps(entries, sort_keys=True).encode() + b"\n"
        size = os.fstat(self.handle).st_size
        between = b"\n" * max(1, len(line) - size)
        os.pwrite(self.handle, between + line, size)
        os.pwrite(self.handle, line, 0)
        os.ftruncate(self.handle, len(line))

    def close(self) -> None:
        """Close the record; remove it if it is empty and nobody else holds a lock."""
        if not self._read() and _try_lock(self.handle, 0, 0) and not self._read():
            self.path.unlink(missing_ok=True)
        os.close(self.handle)


_OPEN: dict[Path, tuple[_Record, int]] = {}
"""Open records of this process with the number of their users. They are shared because
closing any handle of a file would release all locks of the process on it.
"""


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[_Record]:
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
    """Open the record's file; try again if another process removed it meanwhile.

    A link is refused, because it might lead to a file of the user.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    while True:
        if path.is_symlink() or (path.exists() and not path.is_file()):
            raise GraphError(f"{path} is a link, a folder or a pipe: no record of ours")
        handle = os.open(path, flags, 0o644)
        if _is_at(handle, path):
            return handle
        os.close(handle)


def _is_at(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except FileNotFoundError:
        return False


def _try_lock(handle: int, length: int, place: int) -> bool:
    """Take a lock without waiting; file systems without locks grant every one."""
    try:
        fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB, length, place)
    except OSError as error:
        return error.errno in _UNLOCKABLE
    return True


@contextlib.contextmanager
def _locked(handle: int) -> Iterator[None]:
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


def _state(output: Path, name: str | None = None) -> State:
    if not os.path.lexists(output):
        return None
    if not output.is_dir():
        return [_signature(output, name or output.name)]
    files = (file for file in sorted(output.rglob("*")) if not file.is_dir())
    return [_signature(file, str(file.relative_to(output))) for file in files]


def _signature(file: Path, name: str) -> list[str | int]:
    about = file.lstat()
    return [name, about.st_size, about.st_mtime_ns]
