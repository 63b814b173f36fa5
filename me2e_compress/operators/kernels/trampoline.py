"""Write the shared object through which onnxruntime finds our operators.

``SessionOptions.register_custom_ops_library`` opens a shared object and calls its
function ``RegisterCustomOps``; onnxruntime's Python package has no other way. So a
shared object of three functions of one or two instructions is written as bytes: it
needs no compiler on the user's machine and no shipped binary, and has 4 kB (64 kB where
memory pages are larger). Each process puts the address of its own callback into the
object's ``slot``.

It lies in the private folder of compiled kernels. What is there is executed: a folder
that others may write to, or that belongs to another user, is not used.
"""

import ctypes
import dataclasses
import functools
import os
import platform
import stat
import struct
import sys
import tempfile
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import platformdirs

# Bytes from an operator's description to the state of its kernels, which follows it:
# `CreateKernel` is one addition then, and needs no Python
STATE_OFFSET = 0x180

_CODE, _SYMBOLS, _HASH, _NAMES = 0x200, 0x280, 0x380, 0x3C0
_FUNCTIONS = ("RegisterCustomOps", "CreateKernel", "KernelDestroy")
_STEP = 16  # bytes a function takes


@dataclasses.dataclass(frozen=True)
class _Machine:
    """ELF ``e_machine``, largest memory page, and code of a processor."""

    number: int
    page: int
    add: bytes
    nothing: bytes

    def jump(self, distance: int) -> bytes:
        if self.number == 62:  # jmp *slot(%rip)
            return b"\xff\x25" + struct.pack("<i", distance - 6)
        # ldr x16, slot; br x16
        return struct.pack("<II", 0x58000010 | (distance // 4) << 5, 0xD61F0200)


_MACHINES: Mapping[str, _Machine] = {
    "x86_64": _Machine(
        62,
        0x1000,
        b"\x48\x8d\x87" + struct.pack("<i", STATE_OFFSET) + b"\xc3",  # lea, ret
        b"\xc3",
    ),
    "aarch64": _Machine(
        183,
        0x10000,
        struct.pack("<II", 0x91000000 | STATE_OFFSET << 10, 0xD65F03C0),  # add, ret
        struct.pack("<I", 0xD65F03C0),
    ),
}


def shared_object(machine: str) -> bytes:
    """Return the shared object for ``x86_64`` or ``aarch64``: an ELF file."""
    kind = _MACHINES[machine]
    dynamic, slot = kind.page, kind.page + 0x100
    # Functions and their names
    code = [kind.jump(slot - _CODE), kind.add, kind.nothing]
    names = b"\0" + b"".join(f"{name}\0".encode() for name in (*_FUNCTIONS, "slot"))
    places = [names.index(f"{name}\0".encode()) for name in (*_FUNCTIONS, "slot")]
    symbols = bytes(24)
    for index, (place, body) in enumerate(zip(places, code, strict=False)):
        at = _CODE + _STEP * index
        symbols += struct.pack("<IBBHQQ", place, 0x12, 0, 1, at, len(body))
    symbols += struct.pack("<IBBHQQ", places[3], 0x11, 0, 1, slot, 8)
    # one bucket, five symbols, each the next one's predecessor
    # The hash table and the dynamic section
    table = struct.pack("<8I", 1, 5, 1, 0, 2, 3, 4, 0)
    entries = ((4, _HASH), (5, _NAMES), (6, _SYMBOLS), (10, len(names)), (11, 24))
    tags = b"".join(struct.pack("<qQ", *entry) for entry in (*entries, (0, 0)))
    # Put the pieces at their offsets
    file = bytearray(slot + 8)
    pieces = {
        0: _header(kind, dynamic, len(tags)),
        _SYMBOLS: symbols,
        _HASH: table,
        _NAMES: names,
        dynamic: tags,
        **{_CODE + _STEP * index: body for index, body in enumerate(code)},
    }
    for at, piece in pieces.items():
        file[at : at + len(piece)] = piece
    return bytes(file)


def _header(kind: _Machine, dynamic: int, tags: int) -> bytes:
    ident = b"\x7fELF\2\1\1".ljust(16, b"\0")
    sizes = (64, 56, 4, 0, 0, 0)
    head = struct.pack(
        "<16sHHIQQQIHHHHHH", ident, 3, kind.number, 1, 0, 64, 0, 0, *sizes
    )
    segments = (
        (1, 5, 0, 0x400, kind.page),  # code, read and run
        (1, 6, dynamic, 0x108, kind.page),  # the slot, read and written
        (2, 6, dynamic, tags, 8),
        (0x6474E551, 6, 0, 0, 16),  # the stack holds no code
    )
    for sort, flags, at, size, align in segments:
        head += struct.pack("<IIQQQQQQ", sort, flags, at, at, at, size, size, align)
    return head


def default_folder() -> Path:
    """Return the default folder of kernels."""
    return platformdirs.user_cache_path("me2e-compress") / "kernels"


def private(folder: Path) -> Path | None:
    """Return a folder of mode 0700, made if needed; None if others may write to it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError:
        return None
    others = stat.S_IWGRP | stat.S_IWOTH
    mine = status.st_uid == os.getuid() and not status.st_mode & others
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


@dataclasses.dataclass(frozen=True)
class Trampoline:
    """The shared object, open in this process; ``path`` is what onnxruntime opens."""

    path: str
    library: ctypes.CDLL

    def address(self, name: str) -> int:
        """Return the address of a function."""
        address = ctypes.cast(getattr(self.library, name), ctypes.c_void_p).value
        assert address is not None
        return address

    def fill(self, callback: int) -> None:
        """Set the address that ``RegisterCustomOps`` jumps to."""
        ctypes.c_void_p.in_dll(self.library, "slot").value = callback


def load(folder: Path) -> Trampoline:
    """Open the shared object from a private folder or, where that fails, from memory.

    A folder that is not writable, or mounted ``noexec``, is skipped. If memory cannot
    be executed either, it raises an OSError.
    """
    content = shared_object(platform.machine())
    if place := private(folder):
        path = place / f"trampoline-{platform.machine()}.so"
        if keep(path, content):
            try:
                return Trampoline(str(path), ctypes.CDLL(str(path)))
            except OSError:
                pass  # noexec
    handle = os.memfd_create("me2e-trampoline")  # open for as long as the process lives
    os.write(handle, content)
    path_in_memory = f"/proc/self/fd/{handle}"
    return Trampoline(path_in_memory, ctypes.CDLL(path_in_memory))


@functools.cache
def trampoline() -> Trampoline:
    """Open the shared object once per process, or raise an OSError."""
    return load(default_folder())


def why_not() -> str | None:
    """Return why this machine runs no kernels; None if it does."""
    # Nothing is imported for this check: Numba itself may still fail to load
    if sys.platform != "linux":
        return f"there are kernels on Linux only, not on {sys.platform}"
    if platform.machine() not in _MACHINES:
        known = " and ".join(_MACHINES)
        return f"there are kernels for {known} only, not for {platform.machine()}"
    for package in ("numba", "llvmlite"):
        if find_spec(package) is None:
            return f"{package} is not installed: pip install 'me2e-compress[fast]'"
    try:
        trampoline()
    except OSError as error:
        return f"neither the cache folder nor memory may hold code that runs: {error}"
    return None
