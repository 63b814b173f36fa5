"""Write files atomically."""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from me2e_compress.registry import drafts


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically: a draft in the same folder is renamed to it.

    An OSError (folder missing, not writable, or full) leaves no draft.
    """
    with drafts.naming_file(path):
        handle, draft = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            Path(draft).chmod(0o644)
            drafts.put_in_place(Path(draft), path)
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
    write_json(path, drafts.IN_JSON | record, indent)
