"""Read the arrays of a file of the user's, or one line that tells why not."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Array

_UNREADABLE = (
    OSError,
    EOFError,
    ValueError,  # pickled objects, headers that lie
    MemoryError,  # so do they
    RuntimeError,  # encrypted, or compressed as zipfile does not know
    zipfile.BadZipFile,
    zlib.error,
)


def load_arrays(path: Path, what: str = "a readable .npz") -> dict[str, Array]:
    """Read every array of an ``.npz``, by name.

    Args:
        path: the file.
        what: it should be, for the message.

    Raises:
        FramesError: the file cannot be read, or holds something else.
    """
    try:
        with path.open("rb") as source:
            content = np.load(source, allow_pickle=False)
            if not isinstance(content, np.lib.npyio.NpzFile):
                raise FramesError(f"{path}: not {what} (it is a single array)")
            found = {name: content[name] for name in content}
    except _UNREADABLE as error:
        line = " ".join(str(error).split())
        raise FramesError(f"{path}: not {what} ({line})") from error
    for name, value in found.items():
        if not isinstance(value, np.ndarray):
            raise FramesError(f"{path}: not {what} ({name} is not an array)")
    return found
