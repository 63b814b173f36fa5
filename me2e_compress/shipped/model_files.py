"""Write model files atomically."""

import tempfile
from pathlib import Path

from me2e_compress.errors import GraphError
from me2e_compress.registry import drafts


def write(path: Path, content: bytes) -> Path:
    """Write a file atomically, with its folder if needed; errors are GraphErrors."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GraphError(
            f"{path}: its folder cannot be made: {error.strerror}"
        ) from error
    with (
        drafts.written(path, GraphError),
        tempfile.TemporaryDirectory(dir=path.parent, prefix=".model-") as folder,
    ):
        draft = Path(folder) / path.name
        draft.write_bytes(content)
        drafts.put(draft, path)
    return path
