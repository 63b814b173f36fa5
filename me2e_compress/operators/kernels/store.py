"""The folder of compiled kernels: this user's alone, and files in it whole or absent.

What lies there is run. So a folder that others may write to, or that belongs to
somebody else, is not used.
"""

import os
import stat
import tempfile
from pathlib import Path

import platformdirs


def default_folder() -> Path:
    """Return where kernels are kept unless told otherwise."""
    return platformdirs.user_cache_path("me2e-compress") / "kernels"


def private(folder: Path) -> Path | None:
    """Make a folder of mode 0700, or find it; None if it is not this user's alone."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except OSError:
        return None
    others = stat.S_IWGRP | stat.S_IWOTH
    mine = found.st_uid == os.getuid() and not found.st_mode & others
    return folder if mine and os.access(folder, os.W_OK | os.X_OK) else None


def keep(path: Path, content: bytes) -> bool:
    """Write a file all or nothing, unless it stands there already.

    Returns:
        Whether the file holds this content now.
    """
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
