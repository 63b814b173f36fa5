"""Statistics of every tensor on every frame, from which ranges are computed."""

import dataclasses
import functools
import itertools
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.calibration.archives import archive_of, load_arrays
from me2e_compress.calibration.shares import Share, check_whole
from me2e_compress.errors import FramesError
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.runtime.frames import Array

BINS = 2048
"""Bins of a histogram of magnitudes, from 0 to the next power of two: at least 1,024 of
them in use, 8 for each of the 127 int8 steps. (TensorRT divides the range up to the
largest magnitude into 2,048, onnxruntime's percentile each side of zero.)"""

_SMALLEST = -100
"""Least exponent of a histogram: below, float32 cannot hold bins per unit."""

_KEPT = (
    *("model", "source", "tensors", "frames", "measured", "counts", "share"),
    *("inputs", "outputs", "checksums", "scenes"),
)
"""The arrays in a file of statistics."""

ALL_ZERO, NOT_FINITE = 0, -1
"""Checksums of an array of zeros, and of one with NaN or infinity."""

Floats: TypeAlias = npt.NDArray[np.float32]


@dataclasses.dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of a calibration; shards of one recording can be merged.

    Attributes:
        source: fingerprint of the recording.
        frames: indices of the frames in the recording.
        measured: float32 [frames, tensors, 3]: smallest and largest element, mean
            square; infinity, minus infinity and 0 where a tensor had no element.
        counts: int64 [tensors, bins] over all frames: how many magnitudes lie in each
            bin of [0, 2^exponent); None without histograms.
        share: which shard of which sample; None if it is not a shard.
        inputs: names of the graph's inputs.
        outputs: names of the graph's outputs.
        checksums: int64 [frames, inputs + outputs]: :func:`checksum` of what each was.
        scenes: indices of the frames that begin a scene.
    """

    model: str
    source: str
    tensors: tuple[str, ...]
    frames: tuple[int, ...]
    measured: Floats
    counts: npt.NDArray[np.int64] | None = None
    share: Share | None = None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    checksums: npt.NDArray[np.int64] = dataclasses.field(
        default_factory=lambda: np.empty((0, 0), np.int64)
    )
    scenes: tuple[int, ...] = ()

    @functools.cached_property
    def readings(self) -> Floats:
        """The measurements, filled in where a tensor had no element.

        The value is that of the last frame with an element, else of the first such
        frame; 0 if there is none.
        """
        empty = no_element(self.measured)
        if not empty.any():
            return self.measured
        rows = np.arange(len(self.frames))[:, None]
        # Take the last frame with an element, for each tensor.
        last = np.maximum.accumulate(np.where(empty, -1, rows), axis=0)
        taken = np.where(last < 0, np.argmin(empty, axis=0), last)
        filled = self.measured[taken, np.arange(len(self.tensors))]
        return np.where(empty.all(axis=0, keepdims=True).T, np.float32(0), filled)

    @property
    def lows(self) -> Floats:
        """The smallest elements: float32 [frames, tensors]."""
        return self.readings[:, :, 0]

    @property
    def highs(self) -> Floats:
        """The largest elements: float32 [frames, tensors]."""
        return self.readings[:, :, 1]

    @property
    def mean_squares(self) -> Floats:
        """The mean squares: float32 [frames, tensors]."""
        return self.readings[:, :, 2]

    @property
    def reach(self) -> Floats:
        """The largest magnitudes over all frames: float32 [tensors]."""
        magnitudes = np.abs(self.readings[:, :, :2])
        return np.asarray(magnitudes.max(axis=(0, 2), initial=0), np.float32)

    @property
    def exponents(self) -> npt.NDArray[np.int64]:
        """The least e for which 2^e exceeds the reach: int64 [tensors]."""
        return np.maximum(np.frexp(self.reach)[1], _SMALLEST).astype(np.int64)

    def counted(self) -> npt.NDArray[np.int64]:
        """Return the histograms; FramesError if none were collected."""
        if self.counts is None:
            raise FramesError(
                "these statistics hold no histograms: calibrate again with a method"
                " that needs them"
            )
        return self.counts

    def save(self, path: Path) -> None:
        """Write an ``.npz`` atomically; equal statistics give equal bytes."""
        arrays = {
            "model": np.array(self.model),
            "source": np.array(self.source),
            "tensors": np.array(self.tensors, np.str_),
            "frames": np.array(self.frames, np.int64),
            "measured": self.measured,
            "counts": np.empty(0, np.int64) if self.counts is None else self.counts,
            "share": np.array(_listed(self.share), np.int64),
            "inputs": np.array(self.inputs, np.str_),
            "outputs": np.array(self.outputs, np.str_),
            "checksums": self.checksums,
            "scenes": np.array(self.scenes, np.int64),
        }
        write_bytes(path, archive_of(arrays))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what :meth:`save` wrote."""
        if not path.is_file():
            raise FramesError(f"{path}: no such statistics file")
        held: dict[str, npt.NDArray[Any]] = load_arrays(path, "saved statistics")
        if missing := [name for name in _KEPT if name not in held]:
            raise FramesError(
                f"{path}: not saved statistics (no {missing[0]}), or of an earlier"
                " version: measure this shard again"
            )
        # Check shapes and values before they are used.
        counts, names, frames = (held[name] for name in ("counts", "tensors", "frames"))
        fits = counts.size == 0 or counts.shape == (names.size, BINS)
        measured, ports = held["measured"], held["inputs"].size + held["outputs"].size
        fits &= held["checksums"].shape == (frames.size * bool(ports), ports)
        if measured.shape != (*frames.shape, *names.shape, 3) or not fits:
            raise FramesError(f"{path}: not saved statistics (their shapes differ)")
        finite = np.isfinite(measured[..., :2]).all(-1)
        if not (finite | no_element(measured)).all():
            raise FramesError(f"{path}: not saved statistics (a bound is not finite)")
        # An empty array stands for no histograms.
        return cls(
            str(held["model"]),
            str(held["source"]),
            tuple(names.tolist()),
            tuple(frames.tolist()),
            measured,
            counts if counts.size else None,
            _share(held["share"].tolist()),
            tuple(held["inputs"].tolist()),
            tuple(held["outputs"].tolist()),
            held["checksums"],
            tuple(held["scenes"].tolist()),
        )


def checksum(array: Array) -> int:
    """Return what tells two arrays apart: the CRC-32 of the bytes, plus 1.

    It is :data:`ALL_ZERO` where every element is zero, and :data:`NOT_FINITE` where one
    is NaN or infinite.
    """
    if not array.any():
        return ALL_ZERO
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        return NOT_FINITE
    return zlib.crc32(np.ascontiguousarray(array).data.cast("B")) + 1


def no_element(measured: Floats) -> npt.NDArray[np.bool_]:
    """Return which tensors had no element to measure, from float32 [..., 3]."""
    return np.asarray((measured[..., 0] == np.inf) & (measured[..., 1] == -np.inf))


def merge(parts: Sequence[Statistics]) -> Statistics:
    """Merge the shards of one calibration: equal to one run over all frames.

    The result is the same bit for bit, histograms too: their bin widths are powers of
    two, so that the bins of a shard with smaller reach lie within the joint ones.

    Raises:
        FramesError: no shard, one missing, a frame in two of them, or shards of
            different graphs, recordings, tensors, kinds or samples.
    """
    if not parts:
        raise FramesError("no shards to merge")
    first = parts[0]
    # Shards must be of one calibration.
    for each in parts[1:]:
        for what in ("model", "source", "tensors", "inputs", "outputs"):
            if getattr(each, what) != getattr(first, what):
                raise FramesError(
                    f"shards do not belong together: {what} of frames"
                    f" {_span(each)} is not that of frames {_span(first)}"
                )
        if (each.counts is None) != (first.counts is None):
            raise FramesError("only some of the shards have histograms")
    check_whole([each.share for each in parts])
    # Put the frames in order; none may occur twice.
    places = [(place, part, row) for part in parts for row, place in _rows(part)]
    places.sort(key=lambda each: each[0])
    frames = tuple(place for place, _, _ in places)
    if doubles := [a for a, b in itertools.pairwise(frames) if a == b]:
        raise FramesError(f"frame {doubles[0]} is in two of the shards")
    measured, checksums = (
        np.stack([getattr(part, what)[row] for _, part, row in places])
        for what in ("measured", "checksums")
    )
    joint = dataclasses.replace(
        first,
        frames=frames,
        measured=measured,
        counts=None,
        share=None,
        checksums=checksums,
        scenes=tuple(sorted({at for part in parts for at in part.scenes})),
    )
    if first.counts is None:
        return joint
    # Bring all histograms to the same bins.
    counts = sum(_widened(part, joint.exponents) for part in parts)
    return dataclasses.replace(joint, counts=np.asarray(counts, np.int64))


def _rows(part: Statistics) -> list[tuple[int, int]]:
    return list(enumerate(part.frames))


def _listed(share: Share | None) -> list[int]:
    return [] if share is None else [share.number, share.count, *share.drawn]


def _share(listed: list[int]) -> Share | None:
    if len(listed) < 2:
        return None
    return Share(listed[0], listed[1], tuple(listed[2:]))


def _span(part: Statistics) -> str:
    return f"{part.frames[0]} to {part.frames[-1]}" if part.frames else "none"


def _widened(
    part: Statistics, exponents: npt.NDArray[np.int64]
) -> npt.NDArray[np.int64]:
    """Return the histograms over wider bins: 2^k old bins form one new bin."""
    wide = np.zeros_like(part.counted())
    steps = np.minimum(exponents - part.exponents, BINS.bit_length() - 1).tolist()
    for at, step in enumerate(steps):
        folded = part.counted()[at].reshape(-1, 1 << step).sum(axis=1)
        wide[at, : len(folded)] = folded
    return wide
