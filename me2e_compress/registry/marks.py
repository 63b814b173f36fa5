"""The mark of our files: each says in its first or last bytes that we wrote it.

Such a file may be replaced without a word, and any other only by force. The mark goes
with a copy of the file and stays when the user edits it; a user who wants to keep a
file of ours removes the mark or renames the file.
"""

import os
from pathlib import Path

MARK = "me2e-compress wrote this file"
"""What a file says, in a comment or as metadata of its format."""
BYTES = MARK.encode()
"""The mark as the comment of a zip archive, or behind the end of raw data."""
IN_JSON = {"generator": MARK}
IN_TOML = f"# {MARK}\n\n"
IN_MARKDOWN = f"<!-- {MARK} -->\n\n"

PRODUCER = "me2e-compress"
"""What ONNX models name as the program that wrote them."""
_IN_ONNX = b"\x12" + bytes([len(PRODUCER)]) + PRODUCER.encode()
"""ModelProto.producer_name is field 2, and stands before the graph (onnx.proto)."""
_NEAR = 4096
"""Bytes that are read at each end of a file, however large it is."""


def is_marked(path: Path) -> bool:
    """Return whether a file says that we wrote it; of a folder, whether all files do.

    Links are not followed: a link, a pipe or a device is never ours.
    """
    if path.is_symlink():
        return False
    if path.is_dir():
        return all(map(is_marked, path.iterdir()))
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        head = stream.read(_NEAR)
        stream.seek(max(0, os.fstat(stream.fileno()).st_size - _NEAR))
        ends = head, stream.read(_NEAR)
    return _IN_ONNX in head or any(BYTES in each for each in ends)
