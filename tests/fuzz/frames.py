"""Broken recordings: archives that lie, and arrays that no model takes."""

import io
import pickle
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping

import numpy as np

GOOD: Mapping[str, np.ndarray] = {
    "image": np.ones((1, 3, 4, 4), np.float32),
    "memory": np.ones((1, 4, 16), np.float32),
}


def npz(**arrays: np.ndarray) -> bytes:
    """Return an archive as numpy writes it, pickles included."""
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    return content.getvalue()


def member(shape: str, descr: str = "'<f4'", more: int = 0) -> bytes:
    """Return an ``.npy`` whose header says what one likes, and so many zeros."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    text = f"{header:117}\n".encode()
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + bytes(more)


def archive(members: Mapping[str, bytes], kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return a zip archive of these members."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", kind) as made:
        for name, inside in members.items():
            made.writestr(name, inside)
    return content.getvalue()


def broken_frames() -> Iterator[tuple[str, bytes]]:
    """Yield files that stand where a frame of :data:`GOOD` should."""
    good = npz(**GOOD)
    image = GOOD["image"]
    yield from {
        "empty": b"",
        "text": b"not a frame\n",
        "cut": good[:-30],
        "half": good[: len(good) // 2],
        "flipped": good[:60] + bytes([good[60] ^ 255]) + good[61:],
        "npy": member("(1,)", more=4),
        "pickle": pickle.dumps({"image": 1}),
        "object": npz(image=np.array([{}], object)),
        "no-member": archive({}),
        "folder": archive({"image/": b"", "image/a.npy": b""}),
        "not-npy": archive({"image.npy": b"text"}),
        "no-magic": archive({"image": b"text", "memory": b""}),
        "shape-huge": archive({"image.npy": member("(1099511627776, 1099511627776)")}),
        "shape-large": archive({"image.npy": member("(50000, 50000)")}),
        "shape-negative": archive({"image.npy": member("(-1, 3)", more=64)}),
        "shape-digits": archive({"image.npy": member(f"({'9' * 40},)")}),
        "shape-word": archive({"image.npy": member("'x'")}),
        "shape-deep": archive({"image.npy": member("(" * 90 + ")" * 90)}),
        "descr-word": archive({"image.npy": member("(1,)", "'x'", 4)}),
        "descr-code": archive({"image.npy": member("(1,)", "__import__('os')", 4)}),
        "header-short": archive({"image.npy": b"\x93NUMPY\x01\0\xff\xff{"}),
        "version-9": archive({"image.npy": b"\x93NUMPY\x09\0\x01\0\n"}),
        "zeros-behind": archive({"image.npy": member("(1, 3, 4, 4)", more=10**7)}),
        "extra": npz(**GOOD, radar=image),
        "extra-markup": npz(**GOOD, **{"[red]x[/]\x1b[31m\n": image}),
        "missing": npz(memory=GOOD["memory"]),
        "twice": _twice(good),
        "path": archive({"../../image.npy": member("(1,)", more=4)}),
        "double": npz(**{**GOOD, "image": image.astype(np.float64)}),
        "half-float": npz(**{**GOOD, "image": image.astype(np.float16)}),
        "complex": npz(**{**GOOD, "image": image.astype(np.complex64)}),
        "words": npz(**{**GOOD, "image": np.array(["a"])}),
        "dates": npz(**{**GOOD, "image": np.array(["2020-01-01"], "M8[D]")}),
        "fields": npz(**{**GOOD, "image": np.zeros(2, [("a", "f4")])}),
        "void": npz(**{**GOOD, "image": np.zeros(2, "V2")}),
        "bytes": npz(**{**GOOD, "image": np.array([b"a"])}),
        "flat": npz(**{**GOOD, "image": image.ravel()}),
        "scalar": npz(**{**GOOD, "image": np.array(1, np.float32)}),
        "no-elements": npz(**{**GOOD, "image": np.zeros((0, 3, 4, 4), np.float32)}),
        "other-shape": npz(**{**GOOD, "image": np.zeros((1, 3, 4, 5), np.float32)}),
        "nan": npz(**{**GOOD, "image": np.full_like(image, np.nan)}),
        "infinite": npz(**{**GOOD, "image": np.full_like(image, -np.inf)}),
        "largest": npz(**{**GOOD, "image": np.full_like(image, 3e38)}),
        "checksum": _entry(good, 16, struct.pack("<I", zlib.crc32(member("(1,)")))),
        "encrypted": _entry(good, 8, b"\x01\0"),
        "size-lies": _entry(good, 24, struct.pack("<I", 2**31)),
    }.items()


def _twice(good: bytes) -> bytes:
    content = io.BytesIO(good)
    with zipfile.ZipFile(content, "a") as made:
        made.writestr("image2.npy", member("(1,)", more=4))
    return content.getvalue().replace(b"image2.npy", b"memory.npy")


def _entry(good: bytes, offset: int, field: bytes) -> bytes:
    """Write a field of the first entry of an archive's directory."""
    at = good.index(b"PK\x01\x02") + offset
    return good[:at] + field + good[at + len(field) :]
