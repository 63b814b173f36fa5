"""Sketches: a tensor in 33 numbers that tell how far it is from another of its size.

A sketch is linear, so the difference of two sketches is that of the tensors projected.
The tensor is written as a matrix X [rows, columns]; for sign matrices L [4, rows] and
R [columns, 4] the mean square of the elements of L X R is the sum of squares of X in
expectation (Alon, Matias, Szegedy: The space complexity of approximating the frequency
moments, 1996). So one run of each graph compares all of their tensors, and neither has
to keep them. Elements of -1e9 that mask others would hide what those hold: so
x / (1 + |x|) is projected likewise.
"""

import dataclasses
import functools
import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph.shapes import static_shape
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.probing import Reading, shared_constant

Sketches: TypeAlias = npt.NDArray[np.float64]
"""In the last axis: projections, projections of x / (1 + |x|), sum of squares."""

SIDE = 4
PROJECTIONS = SIDE * SIDE
WIDTH = 2 * PROJECTIONS + 1

ROOT_2 = np.float32(math.sqrt(2))

LARGE = 1 << 20
"""Of tensors with more elements only the projections are read, which takes a fifth of
the time: what all probes cost is what these cost."""

LARGEST = 1e15
"""Larger magnitudes are cut off, infinity too: their squares still have a sum."""

CLIP_READS_LIMITS = 11
"""Opset from which Clip takes its limits as inputs."""


@dataclasses.dataclass(frozen=True)
class Sketch:
    """The probe that measures the sketch of a tensor inside its graph.

    Where the size of a tensor is not known before it runs, waves take the place of
    signs.
    """

    width: int = WIDTH

    def read(self, where: ir.Graph, value: ir.Value, at: int) -> Reading:
        """Build the products for the tensor, and for x / (1 + |x|)."""
        kit = _Kit(where)
        shape = static_shape(value)
        size = 0 if shape is None else math.prod(shape)
        rows, columns = (1, -1) if shape is None else sides(size)
        form = kit.constant(np.array([rows, columns]), f"form_{rows}_{columns}")
        small = size <= LARGE
        matrix = kit.add("Reshape", kit.capped(value) if small else value, form)
        if shape is None:
            last = kit.waves(matrix)
        else:
            last = kit.constant(signs(1, columns).T, f"right_{columns}")
        readings = []
        for left in (matrix, kit.add("Softsign", matrix)) if small else (matrix,):
            if shape is not None:
                first = kit.constant(signs(0, rows), f"left_{rows}")
                left = kit.add("MatMul", first, left)
            readings.append(kit.flat(kit.add("MatMul", left, last)))
        if not small:
            square = kit.add("ReduceSumSquare", readings[0], keepdims=0)
            mean = kit.add(
                "Mul", square, kit.constant(np.array([SIDE**-2], np.float32), "mean")
            )
            return kit.nodes, [readings[0], readings[0], kit.flat(mean)]
        square = kit.add("ReduceSumSquare", matrix, keepdims=0)
        return kit.nodes, [*readings, kit.flat(square)]


class _Kit:
    """Builds the nodes of one probe."""

    def __init__(self, where: ir.Graph) -> None:
        self.where = where
        self.nodes: list[ir.Node] = []

    def add(self, op_type: str, *inputs: ir.Value, **attributes: float) -> ir.Value:
        """Add a node of one output."""
        self.nodes.append(ir.node(op_type, inputs, attributes))
        return self.nodes[-1].outputs[0]

    def constant(self, array: Array, name: str) -> ir.Value:
        """Return a constant that all probes share."""
        return shared_constant(self.where, array, name)

    def flat(self, value: ir.Value) -> ir.Value:
        """Make a reading 1-D."""
        return self.add("Reshape", value, self.constant(np.array([-1]), "flat"))

    def capped(self, value: ir.Value) -> ir.Value:
        """Cut off magnitudes beyond what has a square."""
        if self.where.opset_imports.get("", 1) < CLIP_READS_LIMITS:
            return self.add("Clip", value, min=-LARGEST, max=LARGEST)
        low, high = np.float32(-LARGEST), np.float32(LARGEST)
        limits = (
            self.constant(np.array(low), "low"),
            self.constant(np.array(high), "high"),
        )
        return self.add("Clip", value, *limits)

    def waves(self, row: ir.Value) -> ir.Value:
        """Compute the waves of :func:`waves` for a row of any length."""
        zero, one = (self.constant(np.array(n), f"from_{n}") for n in (0, 1))
        steps = self.add("Range", zero, self.add("Size", row), one)
        number = self.add("Cast", steps, to=ir.DataType.FLOAT.value)
        upright = self.constant(np.array([-1, 1]), "upright")
        column = self.add("Reshape", number, upright)
        turns = self.constant(turning(), "turning")
        wave = self.add("Sin", self.add("Mul", column, turns))
        return self.add("Mul", wave, self.constant(np.array(ROOT_2), "root_2"))


def sketch(array: Array, *, sized: bool = True) -> Sketches:
    """Measure the sketch of an array outside any graph: float64 [33].

    ``sized`` is whether its probe in a graph would know its size beforehand.
    """
    wide = np.clip(np.asarray(array, np.float64), -LARGEST, LARGEST)
    rows, columns = sides(wide.size) if sized else (1, wide.size)
    matrix = wide.reshape(rows, columns)
    last = signs(1, columns).T if sized else waves(columns)
    if sized and wide.size > LARGE:
        linear = (signs(0, rows) @ matrix @ last).reshape(-1)
        return np.concatenate([linear, linear, [np.square(linear).mean()]])
    parts = []
    for left in (matrix, matrix / (1 + np.abs(matrix))):
        parts.append(((signs(0, rows) @ left if sized else left) @ last).reshape(-1))
    return np.concatenate([*parts, [np.square(matrix).sum()]])


def waves(count: int) -> npt.NDArray[np.float32]:
    """Compute 16 waves of mean square 1, float32 [count, 16]."""
    steps = np.arange(count, dtype=np.float32)[:, None]
    return np.asarray(np.sin(steps * turning()) * ROOT_2, np.float32)


def turning() -> npt.NDArray[np.float32]:
    """Draw the angle between two neighbours in each wave, float32 [1, 16]."""
    drawn = np.random.default_rng(2).uniform(0.5, 2.5, (1, PROJECTIONS))
    return drawn.astype(np.float32)


@functools.cache
def sides(size: int) -> tuple[int, int]:
    """Return rows x columns of the squarest matrix that holds so many elements."""
    rows = next(n for n in range(math.isqrt(size), 0, -1) if size % n == 0)
    return rows, size // rows


@functools.cache
def signs(side: int, count: int) -> npt.NDArray[np.float32]:
    """Draw 1 and -1, float32 [4, count]: the same for the same side and count."""
    drawn = np.random.default_rng((side, count)).integers(0, 2, (SIDE, count))
    return (2 * drawn - 1).astype(np.float32)


def gap(a: Sketches, b: Sketches) -> npt.NDArray[np.float64]:
    """Return how far tensors are apart, relative to the first: noise over signal.

    Both are amplitudes: 0.1 is an SQNR of 20 dB. Of the tensors and of x / (1 + |x|)
    the larger one counts. Frames, the first axis, are pooled; what is infinite or NaN
    in both is no difference, and in one of them an infinite one.
    """
    one_sided = np.isfinite(a) != np.isfinite(b)
    a, b = (np.where(np.isfinite(each), each, 0.0) for each in (a, b))
    noise = np.square(a - b)[..., :-1]
    soft = slice(PROJECTIONS, 2 * PROJECTIONS)
    found = np.maximum(
        _ratio(noise[..., :PROJECTIONS].mean(-1).sum(0), a[..., -1].sum(0)),
        _ratio(
            noise[..., soft].mean(-1).sum(0), np.square(a[..., soft]).mean(-1).sum(0)
        ),
    )
    return np.where(one_sided.any(axis=(0, -1)), np.inf, found)


def apart(a: Array, b: Array) -> float:
    """Return the same of two whole arrays; infinite where their shapes differ."""
    if a.shape != b.shape:
        return math.inf
    x, y = a.reshape(-1), b.reshape(-1)
    sums = np.zeros((2, 2))  # noise and signal, of the tensors and of x / (1 + |x|)
    for start in range(0, x.size, LARGE):
        part = slice(start, start + LARGE)
        p, q = (np.asarray(each[part], np.float64) for each in (x, y))
        p, q = (np.clip(each, -LARGEST, LARGEST) for each in (p, q))
        neither = np.isnan(p) & np.isnan(q)
        p[neither] = q[neither] = 0.0
        for at in range(2):
            sums[:, at] += np.square(p - q).sum(), np.square(p).sum()
            p, q = p / (1 + np.abs(p)), q / (1 + np.abs(q))
    if np.isnan(sums).any():
        return math.inf
    return float(_ratio(*sums).max())


def decibels(amplitude: float) -> float:
    """Return the SQNR, dB, of noise over signal."""
    if amplitude == 0:
        return math.inf
    return -math.inf if amplitude == math.inf else -20 * math.log10(amplitude)


def _ratio(noise: Sketches, signal: Sketches) -> Sketches:
    """Return the square root of noise / signal; nothing over nothing is nothing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.sqrt(np.asarray(noise, np.float64) / signal)
    return np.where(np.asarray(noise) == 0, 0.0, found)
