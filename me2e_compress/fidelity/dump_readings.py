"""Ways in which the outputs of an engine are read wrongly: arithmetic on a dump.

A reading turns an output as it was dumped into the one that the graph gives, if that is
what went wrong on the host: its bytes are of another type, its axes or slots stand in
another order, or it is multiplied by a constant.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from me2e_compress.runtime.frames import Array

LOWEST_DB, HIGHEST_DB = -20.0, 60.0
"""Closeness is cut here: below, nothing is left of an output; above, two float32
programs differ by the order of their sums (60 dB: 0.1 %)."""
NAMED_DB = 6.0
"""What a fault that is named takes from the residual: three quarters of its power, as
no change does that has nothing to do with the residual (measured by
benchmarks/bench_engine_faults.py)."""
EXPLAINED_DB = 40.0
"""Where every output is so close, nothing is looked for: less than rounding to bfloat16
leaves (8 bits: 48 dB), after a network's many layers."""
MOST_SLOTS = 1024
FITTED_VALUES = 16
"""Fewer values fit a constant or an order by chance: a second frame must agree."""

Order: TypeAlias = tuple[int, ...]


def closeness(truth: Array, found: Array) -> float:
    """Return the SQNR of an output in dB, cut to what says something."""
    if truth.shape != found.shape or not truth.size:
        return LOWEST_DB
    wide = np.asarray(truth, np.float64)
    with np.errstate(all="ignore"):  # bytes of another type are any numbers
        gap = wide - np.asarray(found, np.float64)
        signal, noise = (float(np.vdot(each, each)) for each in (wide, gap))
    if noise == 0:
        return HIGHEST_DB
    if not math.isfinite(noise) or signal == 0:
        return LOWEST_DB
    return min(max(10 * math.log10(signal / noise), LOWEST_DB), HIGHEST_DB)


class Reading(Protocol):
    """One thing that went wrong with an output, undone."""

    @property
    def kind(self) -> str:
        """The fault in a word or two, for programs."""
        ...

    @property
    def said(self) -> str:
        """What is wrong with the output, as the end of a sentence."""
        ...

    def read(self, value: Array, like: Array) -> Array | None:
        """Return the output as it should be; None if its size does not fit."""
        ...


@dataclass(frozen=True)
class Bytes:
    """Bytes of one type, read as another, or in the other byte order."""

    dtype: str
    swapped: bool
    found: str
    kind = "dtype"

    @property
    def said(self) -> str:
        """Name both types."""
        if self.swapped and self.dtype == self.found:
            return f"holds {self.dtype} in the other byte order"
        order = ", in the other byte order" if self.swapped else ""
        return f"holds the bytes of {self.dtype}{order}, read as {self.found}"

    def read(self, value: Array, like: Array) -> Array | None:
        """Take as many values as the graph gives from the bytes."""
        stored = np.dtype("uint16" if self.dtype == "bfloat16" else self.dtype)
        content = np.ascontiguousarray(value).tobytes()
        needed = like.size * stored.itemsize
        if len(content) < needed:
            return None
        stored = stored.newbyteorder(">") if self.swapped else stored
        values: Array = np.frombuffer(content[:needed], stored)
        if self.dtype == "bfloat16":  # the upper half of a float32
            values = (values.astype(np.uint32) << 16).view(np.float32)
        return values.reshape(like.shape)


@dataclass(frozen=True)
class Layout:
    """Axes in another order, or values without their shape.

    ``order`` are the graph's axes in the order in which the dump holds them.
    """

    order: Order
    shape: tuple[int, ...]
    kind = "layout"

    @property
    def said(self) -> str:
        """Name the order of the axes, or the shape."""
        if self.order == tuple(range(len(self.order))):
            return f"has the shape {list(self.shape)}, its values in the graph's order"
        return f"holds the graph's axes in the order {', '.join(map(str, self.order))}"

    def read(self, value: Array, like: Array) -> Array | None:
        """Give the values the graph's shape and order."""
        if value.size != like.size or len(self.order) != like.ndim:
            return None
        held = value.reshape([like.shape[axis] for axis in self.order])
        return held.transpose(np.argsort(self.order))


@dataclass(frozen=True)
class Scaled:
    """An output multiplied by a constant."""

    factor: float
    kind = "scale"

    @property
    def said(self) -> str:
        """Name the factor."""
        return f"is the graph's times {self.factor:.4g}"

    def read(self, value: Array, like: Array) -> Array | None:
        """Divide by the factor."""
        return np.asarray(value, np.float64) / self.factor


@dataclass(frozen=True)
class Slots:
    """Slots along an axis in another order, the same on every frame.

    ``order`` says for each slot of the graph where the dump has it.
    """

    axis: int
    order: Order
    kind = "slots"

    @property
    def said(self) -> str:
        """Name the axis and what became of its slots."""
        moved = [f"{at} at {to}" for at, to in enumerate(self.order) if at != to]
        if self.order == tuple(reversed(range(len(self.order)))):
            told = "reversed"
        else:
            told = ", ".join(moved[:3]) + (", ..." if moved[3:] else "")
        return f"has the slots of axis {self.axis} in another order: {told}"

    def read(self, value: Array, like: Array) -> Array | None:
        """Put the slots into the graph's order."""
        if value.ndim <= self.axis or value.shape[self.axis] != len(self.order):
            return None
        return np.take(value, self.order, axis=self.axis)


def undone(readings: Sequence[Reading], value: Array, like: Array) -> Array | None:
    """Return an output with all readings applied; None if one does not fit."""
    for each in readings:
        found = each.read(value, like)
        if found is None:
            return None
        value = found
    return value


def find_readings(
    values: Sequence[Array], likes: Sequence[Array]
) -> tuple[Reading, ...]:
    """Return what brings an output to the graph's answer on frames; empty if nothing.

    Constants and orders are fitted on the first frame, and must hold on the others.
    """
    found = tuple[Reading, ...]()
    reached = _closeness(found, values, likes)
    for _ in range(2):
        read = [
            undone(found, value, like)
            for value, like in zip(values, likes, strict=True)
        ]
        trials = [
            (_closeness((*found, each), values, likes), each)
            for each in _candidates(read[0], likes)
        ]
        # the first of equals: the order of candidates is from common to rare
        best, taken = max(trials, key=lambda trial: trial[0], default=(LOWEST_DB, None))
        if taken is None or best - reached < NAMED_DB:
            break
        found, reached = (*found, taken), best
    return found


def _closeness(
    readings: Sequence[Reading], values: Sequence[Array], likes: Sequence[Array]
) -> float:
    """Return the mean closeness on frames; what is fitted is not judged on the first.

    A mean, since an engine may choose another plan or order of agents on one frame.
    """
    fitted = any(isinstance(each, Scaled | Slots) for each in readings)
    begin = 1 if fitted and len(values) > 1 else 0
    found = list[float]()
    for value, like in zip(values[begin:], likes[begin:], strict=True):
        with np.errstate(all="ignore"):
            read = undone(readings, value, like)
        found.append(LOWEST_DB if read is None else closeness(like, read))
    return float(np.mean(found))


def _candidates(value: Array | None, likes: Sequence[Array]) -> Iterator[Reading]:
    """Propose readings of an output on the first frame, from common to rare."""
    if value is None:
        return
    like = likes[0]
    yield from _layouts(value, like)
    # zeros fit by chance; integers without a scale are whole numbers
    told = sum(int(np.count_nonzero(each)) for each in likes)
    types = [like.dtype.name, "float16", "bfloat16", "float32"] if told else []
    if told >= FITTED_VALUES and not any(np.mod(each, 1).any() for each in likes):
        types += ["int8", "int32"]
    for name, swapped in itertools.product(dict.fromkeys(types), (False, True)):
        if (name, swapped) != (value.dtype.name, False) and (name, swapped) != (
            *("int8", True),
        ):
            yield Bytes(name, swapped, value.dtype.name)
    # constants and orders need the shape
    if value.shape != like.shape or (len(likes) == 1 and like.size < FITTED_VALUES):
        return
    wide, true = (np.asarray(each, np.float64) for each in (value, like))
    if not np.isfinite(wide).all() or not true.any():
        return
    factor = float(np.vdot(true, wide) / np.vdot(true, true))
    if factor and math.isfinite(factor):
        yield Scaled(factor)
    for axis, size in enumerate(like.shape):
        if 1 < size <= MOST_SLOTS:
            yield from _slots(axis, wide, true)


def _layouts(value: Array, like: Array) -> Iterator[Layout]:
    """Propose orders of the axes that are longer than 1."""
    axes = [axis for axis, size in enumerate(like.shape) if size > 1]
    if len(axes) > 5:
        return
    for moved in itertools.permutations(axes):
        order = list(range(like.ndim))
        for axis, to in zip(axes, moved, strict=True):
            order[axis] = to
        if order != sorted(order) or value.shape != like.shape:
            yield Layout(tuple(order), value.shape)


def _slots(axis: int, value: Array, like: Array) -> Iterator[Slots]:
    """Propose the order of slots in which each is nearest to one of the graph's."""
    from scipy.optimize import linear_sum_assignment  # takes long to import

    rows, others = (
        np.moveaxis(np.asarray(each, np.float64), axis, 0).reshape(len_of, -1)
        for each, len_of in ((like, like.shape[axis]), (value, like.shape[axis]))
    )
    squares = (rows**2).sum(axis=1)[:, None] + (others**2).sum(axis=1)
    _, columns = linear_sum_assignment(squares - 2 * rows @ others.T)
    order = tuple(int(each) for each in columns)
    if order != tuple(range(len(order))):
        yield Slots(axis, order)
