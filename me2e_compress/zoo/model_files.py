"""Files of models, written all or nothing."""

import tempfile
from pathlib import Path

from me2e_compress import drafts
from me2e_compress.errors import GraphError


def write(path: Path, content: bytes) -> Path:
    """Write a file, and its folder where there is none, and return the path.

    Args:
        path: The file; replaced in one step.
        content: All of it.

    Raises:
        GraphError: It is a folder, its folder cannot be made, or the disk refuses.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GraphError(
            f"{path}: its folder cannot be made: {error.strerror}"
        ) from error
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".model-") as folder:
            draft = Path(folder) / path.name
            draft.write_bytes(content)
            drafts.put(draft, path)
    except OSError as error:
        raise GraphError(f"{path}: cannot be written: {error.strerror}") from error
    return path
