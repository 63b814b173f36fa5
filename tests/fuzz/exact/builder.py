"""A graph that grows node by node, its shapes and types known by construction.

One dimension of a value may be open.
"""

import dataclasses
import itertools
import math
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import onnx
from onnx import helper, numpy_helper

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
    return math.prod(n if isinstance(n, int) else n.times * batch for n in shape)


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

    def is_rows(self, least: int = 1) -> bool:
        """Say whether its last axis has a known size that is small."""
        last = self.shape[-1] if self.shape else 0
        return isinstance(last, int) and least <= last <= 64

    @property
    def width(self) -> int:
        """The size of its last axis, which must be known."""
        last = self.shape[-1]
        assert isinstance(last, int)
        return last


class Shared:
    """What a graph and the bodies within it have in common: drawn for the whole."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = random.Random(seed)
        self.draws = np.random.default_rng(seed)
        self.batch: Dim = Open() if rng.random() < 0.2 else rng.choice((1, 1, 2, 3, 5))
        self.opset = rng.randint(11, 21)
        self.dtype = np.dtype(np.float64 if rng.random() < 0.25 else np.float32)
        self.listed_weights = rng.random() < 0.15
        self.named = rng.choice(("", "plain", "modules"))
        self.numbers = itertools.count()
        self.functions = list[onnx.FunctionProto]()
        self.domains = dict[str, int]()
        self.motifs = list[str]()


def port(value: Val) -> onnx.ValueInfoProto:
    """Declare a value; a multiple of the batch has a symbol of its own."""
    symbols = {1: "N"}
    dims: list[int | str] = [
        n if isinstance(n, int) else symbols.get(n.times, f"N_times_{n.times}")
        for n in value.shape
    ]
    kind = helper.np_dtype_to_tensor_dtype(value.dtype)
    return helper.make_tensor_value_info(value.name, kind, dims)


class Builder:
    """Nodes, inputs and weights of one graph, or of a body within it.

    Args:
        shared: what it shares with the graphs around it.
        outer: the values around it that it may capture.
        around: who builds the graph around it.
    """

    def __init__(
        self, shared: Shared, outer: Sequence[Val] = (), around: "Builder | None" = None
    ) -> None:
        self.shared, self.outer, self.around = shared, tuple(outer), around
        self.rng, self.draws = shared.rng, shared.draws
        self.opset, self.dtype = shared.opset, shared.dtype
        self.nodes: list[onnx.NodeProto] = []
        self.inputs: list[Val] = []
        self.initializers: list[onnx.TensorProto] = []
        self.values: list[Val] = []
        self.weights: list[Val] = []
        self.hidden: set[str] = set()
        self.scope = "model"

    # -- drawing ---------------------------------------------------------------

    def chance(self, probability: float) -> bool:
        return self.rng.random() < probability

    @property
    def is_double(self) -> bool:
        return self.dtype == np.float64

    def normal(self, shape: Sequence[int], scale: float = 1.0) -> Array:
        return np.asarray(self.draws.normal(size=tuple(shape)) * scale, self.dtype)

    def uniform(self, low: float, high: float, shape: Sequence[int]) -> Array:
        return np.asarray(self.draws.uniform(low, high, tuple(shape)), self.dtype)

    def fresh(self, hint: str) -> str:
        return f"{hint}{next(self.shared.numbers)}"

    # -- values ----------------------------------------------------------------

    def input(self, shape: Sequence[Dim], dtype: np.dtype[Any] | None = None) -> Val:
        """Add an input of the graph; a body captures one of the graph around it."""
        if self.around is not None:
            return self.around.input(shape, dtype)
        value = Val(self.fresh("x"), tuple(shape), dtype or self.dtype)
        self.inputs.append(value)
        self.values.append(value)
        return value

    def const(self, array: npt.ArrayLike, *, plain: bool = False) -> Val:
        """Add a constant: an initializer, or a node; ``plain`` asks for the first."""
        held = np.asarray(array)
        name = self.fresh("c")
        if self.shared.named == "modules" and held.ndim > 1:
            name = f"{self.scope}.{name}.weight"
        value = Val(name, held.shape, held.dtype, held)
        if plain or self.chance(0.7):
            self.initializers.append(numpy_helper.from_array(held, name))
        else:
            tensor = numpy_helper.from_array(held)
            self._add(helper.make_node("Constant", [], [name], value=tensor))
        return value

    def ints(self, *values: int) -> Val:
        return self.const(np.array(values, np.int64))

    def weight(self, shape: Sequence[int], scale: float | None = None) -> Val:
        """Add a weight, or take one of that shape that is there already."""
        wanted = tuple(shape)
        known = [each for each in self.weights if each.shape == wanted]
        if known and self.chance(0.2):
            return self.rng.choice(known)
        size = float(np.sqrt(max(1, int(np.prod(wanted[:-1])))))
        made = self.const(self.normal(wanted, 1 / size if scale is None else scale))
        self.weights.append(made)
        return made

    def op(
        self,
        kind: str,
        inputs: Sequence[Val | None],
        shape: Sequence[Dim],
        attributes: Attributes | None = None,
        *,
        dtype: np.dtype[Any] | None = None,
        domain: str = "",
    ) -> Val:
        """Add a node of one output; the output's type is that of the first input."""
        first = next((each.dtype for each in inputs if each is not None), self.dtype)
        value = Val(self.fresh("v"), tuple(shape), dtype or first)
        self.emit(kind, inputs, [value], attributes, domain=domain)
        return value

    def emit(
        self,
        kind: str,
        inputs: Sequence[Val | None],
        outputs: Sequence[Val],
        attributes: Attributes | None = None,
        *,
        domain: str = "",
    ) -> None:
        """Add a node whose outputs are made already."""
        if any(elements(each.shape, 9) > LARGEST for each in outputs):
            raise TooLargeError
        read = ["" if each is None else each.name for each in inputs]
        while read and not read[-1] and self.chance(0.8):
            read.pop()
        names = [each.name for each in outputs]
        if domain:
            self.shared.domains.setdefault(domain, 1)
        node = helper.make_node(kind, read, names, domain=domain, **(attributes or {}))
        self._add(node)
        self.values.extend(each for each in outputs if each.name)

    def _add(self, node: onnx.NodeProto) -> None:
        if self.shared.named == "modules":
            scope = self.scope.replace(".", "/")
            node.name = f"/{scope}/{node.op_type}_{len(self.nodes)}"
        elif self.shared.named == "plain":
            node.name = self.fresh("n")
        self.nodes.append(node)

    # -- choosing what a motif reads -------------------------------------------

    def floats(self) -> list[Val]:
        """List what a motif may read, the latest last."""
        return [
            each
            for each in (*self.outer, *self.values)
            if each.dtype == self.dtype
            and each.name not in self.hidden
            and elements(each.shape) <= 1 << 16
        ]

    def hide(self, value: Val) -> Val:
        """Keep other motifs from reading a value that is not finite."""
        self.hidden.add(value.name)
        return value

    def pick(self, wanted: Callable[[Val], bool]) -> Val | None:
        """Choose a value, the latest most often; None if there is none."""
        found = [each for each in self.floats() if wanted(each)]
        if not found:
            return None
        return found[-1] if self.chance(0.6) else self.rng.choice(found)

    def rows(self, least: int = 2, most: int = 4) -> Val:
        """Choose or make a value of rows: its last axis has a known size."""
        fits = range(least, most + 1)
        found = self.pick(lambda each: each.rank in fits and each.is_rows(2))
        return found or self.source(least, most)

    def source(self, least: int = 2, most: int = 4) -> Val:
        """Make an input of rows, or reshape one that has as many elements."""
        rank = self.rng.randint(least, most)
        middle = [self.rng.randint(1, 5) for _ in range(rank - 2)]
        width = self.rng.choice((4, 6, 8, 12, 16))
        shape: list[Dim] = [*middle, width]
        first = self.shared.batch if self.chance(0.7) else self.rng.randint(1, 6)
        return self.input([first, *shape])

    def image(self) -> Val:
        """Choose or make a value [B, C, H, W] with small C, H, W."""
        found = self.pick(
            lambda each: (
                each.rank == 4
                and is_static(each.shape[1:])
                and elements(each.shape[2:]) <= 64
                and elements(each.shape[1:2]) <= 24
            )
        )
        if found is not None:
            return found
        first = self.shared.batch if self.chance(0.6) else self.rng.randint(1, 3)
        size = self.rng.randint(2, 6)
        return self.input([first, self.rng.choice((4, 6, 8)), size, size])

    # -- bodies ----------------------------------------------------------------

    def inner(self) -> "Builder":
        """Begin a body that may capture what is here."""
        body = Builder(self.shared, [*self.outer, *self.values], self)
        body.weights, body.hidden = list(self.weights), set(self.hidden)
        body.scope = self.scope
        return body

    def graph(self, outputs: Sequence[Val], name: str) -> onnx.GraphProto:
        """Write the graph."""
        given, made = map(port, self.inputs), map(port, outputs)
        return helper.make_graph(
            self.nodes, name, list(given), list(made), self.initializers
        )
