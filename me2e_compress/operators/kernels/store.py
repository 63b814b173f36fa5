"""A private folder of compiled kernels, whose files are written atomically.

Its content is executed: a folder that others may write to, or that belongs to another
user, is not used.
"""

import os
import stat
import tempfile
from pathlib import Path

import platformdirs


def default_folder() -> Path:
    """Return the default folder of kernels."""
    return platformdirs.user_cache_path("me2e-compress") / "kernels"


def private(folder: Path) -> Path | None:
    """Return a folder of mode 0700, made if needed; None if others may write to it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except OSError:
        return None
    others = stat.S_IWGRP | stat.S_IWOTH
    mine = found.st_uid == os.getuid() and not found.st_mode & others
    return folder if mine and os.access(folder, os.W_OK | os.X_OK) else None


def keep(path: Path, content: bytes) -> bool:
    """Write a file atomically, unless unchanged; return whether it has the content."""
    try:
        if path.read_bytes() == content:
            return True
    except OSError:
        pass
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as draft:
            draft.write(content)
        os.replace(draft.name, path)
    except OSError:
        return False
    return True
