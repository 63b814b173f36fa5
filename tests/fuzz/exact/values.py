"""Values of a drawn graph and their shapes, one dimension of which may be open."""

import dataclasses
import itertools
import math
import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import onnx
from onnx import helper

Array: TypeAlias = npt.NDArray[Any]
Attributes: TypeAlias = Mapping[str, Any]

INT64 = np.dtype(np.int64)
BOOL = np.dtype(np.bool_)

SCOPES = (
    "img_backbone.layer1", "img_backbone.conv1", "img_neck.lateral_convs.0",
    "pts_bbox_head.transformer.encoder.layers.0", "pts_bbox_head.map_decoder",
    "motion_head.agent", "planning_head.reg_branch",
)  # fmt: skip
"""Module paths that nodes and weights are named after."""


LARGEST = 1 << 18
"""Elements that a value may have."""


class TooLargeError(Exception):
    """A motif would make a value that is too large; what it made so far stays."""


@dataclasses.dataclass(frozen=True)
class Open:
    """A multiple of the batch, whose size only the inputs tell."""

    times: int = 1


Dim: TypeAlias = int | Open
Shape: TypeAlias = tuple[Dim, ...]


def product(dims: Iterable[Dim]) -> Dim:
    """Multiply dimensions, of which at most one is open."""
    listed = list(dims)
    factor = math.prod(each for each in listed if isinstance(each, int))
    opened = [each for each in listed if isinstance(each, Open)]
    if not opened:
        return factor
    (one,) = opened
    return Open(one.times * factor)


def is_static(shape: Iterable[Dim]) -> bool:
    return all(isinstance(each, int) for each in shape)


def sizes(shape: Iterable[Dim]) -> tuple[int, ...]:
    """Return a shape that has no open dimension."""
    found = [each for each in shape if isinstance(each, int)]
    assert is_static(shape)
    return tuple(found)


def elements(shape: Sequence[Dim], batch: int = 3) -> int:
    """Count the elements at some size of the batch."""
    return math.prod(concrete(shape, batch))


def concrete(shape: Iterable[Dim], batch: int) -> tuple[int, ...]:
    """Put a size in the place of the batch."""
    return tuple(
        each if isinstance(each, int) else each.times * batch for each in shape
    )


def broadcast(*shapes: Sequence[Dim]) -> Shape:
    """Return the shape that these are broadcast to."""
    rank = max(map(len, shapes))
    result: list[Dim] = []
    for axis in range(-rank, 0):
        found = {shape[axis] for shape in shapes if len(shape) >= -axis} - {1}
        if len(found) > 1:
            raise ValueError(f"{shapes} are not broadcast")
        result.append(next(iter(found), 1))
    return tuple(result)


@dataclasses.dataclass(frozen=True)
class Val:
    """A value of the graph.

    Attributes:
        name: of the value.
        shape: with at most one open dimension.
        dtype: of its elements.
        array: what it holds, where it is constant.
    """

    name: str
    shape: Shape
    dtype: np.dtype[Any]
    array: Array | None = None

    @property
    def rank(self) -> int:
        return len(self.shape)

    @property
    def width(self) -> int:
        """The size of its last axis, which must be known."""
        last = self.shape[-1]
        assert isinstance(last, int)
        return last


@dataclasses.dataclass
class Shared:
    """What a graph and the bodies within it have in common."""

    rng: random.Random
    draws: np.random.Generator
    opset: int
    dtype: np.dtype[Any]
    batch: Dim
    listed_weights: bool
    named: str
    numbers: Iterator[int]
    functions: list[onnx.FunctionProto] = dataclasses.field(default_factory=list)
    domains: dict[str, int] = dataclasses.field(default_factory=dict)
    motifs: list[str] = dataclasses.field(default_factory=list)


def port(value: Val) -> onnx.ValueInfoProto:
    """Declare a value; a multiple of the batch has a symbol of its own."""
    dims: list[int | str] = [
        each
        if isinstance(each, int)
        else ("N" if each == Open() else f"N_times_{each.times}")
        for each in value.shape
    ]
    kind = helper.np_dtype_to_tensor_dtype(value.dtype)
    return helper.make_tensor_value_info(value.name, kind, dims)


def shared(seed: int) -> Shared:
    """Draw what holds for a whole graph."""
    rng = random.Random(seed)
    batch: Dim = Open() if rng.random() < 0.2 else rng.choice((1, 1, 2, 3, 5))
    return Shared(
        rng,
        np.random.default_rng(seed),
        rng.randint(11, 21),
        np.dtype(np.float64 if rng.random() < 0.25 else np.float32),
        batch,
        rng.random() < 0.15,
        rng.choice(("", "plain", "modules")),
        itertools.count(),
    )
