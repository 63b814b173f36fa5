"""JSON and TOML that someone else wrote: read whole, or refused in one line.

What Python's parsers take or break on is refused here, once for all formats: nesting
without end, numbers of thousands of digits, lone surrogates and irregular files.
"""

import json
import re
import stat
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from me2e_compress.base.display import error_line

# The largest document that is read; a plan of 30,000 nodes has 15 MB. Read, it may take
# thirty times as much memory.
LARGEST_BYTES = 64_000_000
# The largest file of documents that are read line by line
LARGEST_LOG_BYTES = 256_000_000
# People write TOML, and Python reads a megabyte a second or less
LARGEST_TOML_BYTES = 4_000_000


# What numpy and zipfile raise on a file that holds no valid arrays
NPZ_ERRORS = (
    OSError,
    EOFError,
    ValueError,  # pickled objects, headers that lie
    SyntaxError,  # or are no Python
    OverflowError,
    RecursionError,
    MemoryError,
    RuntimeError,  # encrypted, or compressed as zipfile does not know
    zipfile.BadZipFile,
    zlib.error,
)


def _reject_constant(word: str) -> None:
    raise ValueError(f"{word} is not a number")


_DECODER = json.JSONDecoder(parse_constant=_reject_constant)
_ANY_NUMBER = json.JSONDecoder()
_LONE_SURROGATE = re.compile("[\ud800-\udfff]")


class MalformedError(ValueError):
    """A text is not what it should be; the message is one line, without the file."""


@contextmanager
def reading(
    path: Path | str, error: Callable[[str], Exception], otherwise: str
) -> Iterator[None]:
    """Raise whatever fails while this block reads a file as one line that names it.

    ``error`` makes the exception of the line. ``otherwise`` is the line's word for a
    file whose content does not fit, e.g. "not TOML"; the first misfit follows.
    """
    try:
        yield
    except OSError as cause:
        raise error(f"{path}: {cause.strerror}") from cause
    except (MalformedError, UnicodeDecodeError) as cause:
        raise error(f"{path}: {otherwise}: {cause}") from cause
    except ValidationError as cause:
        first = cause.errors(include_url=False)[0]
        location = ".".join(map(str, first["loc"])) or "the file"
        raise error(f"{path}: {otherwise}: {location}: {first['msg']}") from cause


def check_regular(path: Path) -> None:
    """Raise a MalformedError of a folder, a device or a pipe, which may never end."""
    if not stat.S_ISREG(path.stat().st_mode):
        what = "it is a folder, " if path.is_dir() else ""
        raise MalformedError(f"{what}not a regular file")


def read_bytes(path: Path, most: int = LARGEST_BYTES) -> bytes:
    """Read a regular file of at most so many bytes; OSError or MalformedError."""
    check_regular(path)
    _check_size(path.stat().st_size, most)
    return path.read_bytes()


def from_json(text: bytes | str, *, finite: bool = True) -> Any:
    """Read a JSON document; anything else is a MalformedError.

    So are NaN and infinities, unless ``finite`` is False.
    """
    try:
        # Python's own writer writes NaN: who takes it must look at the numbers
        document = (_DECODER if finite else _ANY_NUMBER).decode(_decode(text))
    except RecursionError as error:
        raise MalformedError("nested too deeply") from error
    except ValueError as error:
        raise MalformedError(error_line(error)) from error
    _check_strings(document)
    return document


def from_toml(text: bytes | str) -> dict[str, Any]:
    """Read a TOML document; anything else is a MalformedError."""
    try:
        _check_size(len(text), LARGEST_TOML_BYTES)
        return tomllib.loads(_decode(text))
    except RecursionError as error:
        raise MalformedError("nested too deeply") from error
    except ValueError as error:
        raise MalformedError(error_line(error)) from error


def _check_size(size: int, most: int) -> None:
    if size > most:
        raise MalformedError(f"{size:,} bytes are too many: {most:,} may be")


def _decode(text: bytes | str) -> str:
    # editors of Windows put a byte order mark before it
    return text if isinstance(text, str) else text.decode("utf-8-sig")


def _check_strings(value: object) -> None:
    """Raise a MalformedError of lone surrogates, which no file can hold."""
    # Without recursion: documents may be deep
    waiting = [value]
    while waiting:
        item = waiting.pop()
        if isinstance(item, dict):
            waiting += (*item.keys(), *item.values())
        elif isinstance(item, list):
            waiting += item
        elif isinstance(item, str) and _LONE_SURROGATE.search(item):
            raise MalformedError("a string holds half a surrogate pair")


def toml_string(text: str) -> str:
    """Write a TOML string: JSON's escapes are valid in TOML, except for delete."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
