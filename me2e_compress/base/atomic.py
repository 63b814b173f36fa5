"""Files that take their place in one step, several as a set, and bear our mark.

A file of ours says in its first or last bytes that we wrote it, and may be replaced
without a word; any other only by force. The mark goes with a copy of the file and stays
when the user edits it; a user who wants to keep a file of ours removes the mark or
renames the file.
"""

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# What a file says, in a comment or as metadata of its format
MARK = "me2e-compress wrote this file"
# The mark as the comment of a zip archive, or after the end of raw data
BYTES = MARK.encode()
IN_JSON = {"generator": MARK}
IN_TOML = f"# {MARK}\n\n"
IN_MARKDOWN = f"<!-- {MARK} -->\n\n"

# What ONNX models name as the program that wrote them
PRODUCER = "me2e-compress"
# ModelProto.producer_name is field 2, and stands before the graph (onnx.proto)
_IN_ONNX = b"\x12" + bytes([len(PRODUCER)]) + PRODUCER.encode()
# Bytes that are read at each end of a file, however large it is
_END_BYTES = 4096


def is_marked(path: Path) -> bool:
    """Return whether a file, or all of a folder, say that we wrote them."""
    # Links are not followed: a link, a pipe or a device is never ours
    if path.is_symlink():
        return False
    if path.is_dir():
        return all(map(is_marked, path.iterdir()))
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        # The mark is in the first or last bytes, however large the file
        head = stream.read(_END_BYTES)
        stream.seek(max(0, os.fstat(stream.fileno()).st_size - _END_BYTES))
        ends = head, stream.read(_END_BYTES)
    return _IN_ONNX in head or any(BYTES in end for end in ends)


# Of each open block: the places where something was put, and what was there.
_SETS: list[list[tuple[Path, Path]]] = []


def put_in_place(draft: Path, path: Path) -> None:
    """Rename a draft to its path, in the same file system; replace a file or folder."""
    # A file is replaced at once
    if not draft.is_dir():
        _back_up(path)
        os.replace(draft, path)
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    if path.exists():  # a folder is renamed at once, and removed file by file
        os.replace(path, aside)
    os.replace(draft, path)
    shutil.rmtree(aside, ignore_errors=True)


def remove(path: Path) -> None:
    """Remove a file, if it is there; :func:`all_or_none` may restore it."""
    _back_up(path)
    path.unlink(missing_ok=True)


@contextlib.contextmanager
def all_or_none() -> Iterator[None]:
    """Restore the files that are replaced or removed in this block if it raises."""
    # What was there before is kept until the end, as a second link to the same file
    saved: list[tuple[Path, Path]] = []
    _SETS.append(saved)
    try:
        yield
    except BaseException:
        for path, before in reversed(saved):
            if os.path.lexists(before):
                os.replace(before, path)
            else:
                path.unlink(missing_ok=True)
        raise
    finally:
        _SETS.pop()
        for _, before in saved:
            shutil.rmtree(before.parent, ignore_errors=True)


def _back_up(path: Path) -> None:
    """Link what is at a path for :func:`all_or_none`, if such a block is open."""
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
def naming_file(path: Path) -> Iterator[None]:
    """Let OSErrors in this block name a file instead of its draft."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextlib.contextmanager
def writing_errors(path: Path, error: Callable[[str], Exception]) -> Iterator[None]:
    """Turn OSErrors in this block into an error whose one line names the file."""
    try:
        yield
    except OSError as cause:
        raise error(f"{path}: cannot be written: {cause.strerror}") from cause


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically: a draft in the same folder is renamed to it."""
    with naming_file(path):
        # The draft is on disk before it takes the place
        handle, draft = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            Path(draft).chmod(0o644)
            put_in_place(Path(draft), path)
        # A folder that is missing, not writable or full leaves no draft
        except BaseException:
            Path(draft).unlink(missing_ok=True)
            raise


def write_json(path: Path, record: dict[str, Any], indent: int | None = None) -> None:
    """Write a JSON file atomically; the same record gives the same bytes."""
    text = json.dumps(record, indent=indent, allow_nan=False, ensure_ascii=False)
    write_bytes(path, f"{text}\n".encode())


def write_document(
    path: Path, record: dict[str, Any], indent: int | None = None
) -> None:
    """Write a JSON file that says that we wrote it, and may so be replaced."""
    write_json(path, IN_JSON | record, indent)
