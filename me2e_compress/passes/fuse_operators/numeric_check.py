"""Compare matched nodes with the fused node's body on random numbers."""

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import array_of, digest, opset_of
from me2e_compress.graph.nodes import Array
from me2e_compress.operators import OWN_DOMAIN, expand
from me2e_compress.passes.digits import flat, sizes
from me2e_compress.passes.fuse_operators.decomposed import XY
from me2e_compress.passes.fuse_operators.views import View
from me2e_compress.runtime.session import Session

# How far beyond a feature map's edges positions are drawn, relative to its size.
OUTSIDE = 0.25

# The IR version of pieces: that of the first onnxruntime with GridSample.
IR_VERSION = 8


def nodes_between(output: ir.Value, inputs: Sequence[ir.Value]) -> list[ir.Node]:
    """Return the nodes that compute a value from others and constants, in order."""
    known: dict[ir.Node, None] = {}
    stops, stack = set(inputs), [(output.producer(), False)]
    while stack:
        node, done = stack.pop()
        if node is None or node in known:
            continue
        if done:
            known[node] = None
            continue
        stack.append((node, True))
        stack.extend(
            (value.producer(), False)
            for value in reversed(node.inputs)
            if value is not None and value not in stops
        )
    return list(known)


def piece_of(output: ir.Value, inputs: Sequence[ir.Value], opset: int) -> ir.Model:
    """Copy the nodes between values as a model of its own, with numbered names."""
    nodes = nodes_between(output, inputs)
    known = {*inputs, *(value for node in nodes for value in node.outputs)}
    read = dict.fromkeys(value for node in nodes for value in node.inputs if value)
    weights = [value for value in read if value not in known]
    for value in weights:
        if array_of(value) is None:
            raise PreconditionError(f"it reads {value.name} besides")
    imports = {"": opset, OWN_DOMAIN: 1}
    body = ir.GraphView(
        inputs, [output], nodes=nodes, initializers=weights, opset_imports=imports
    ).clone()
    # Equal pieces have equal names
    made = (value for node in body for value in node.outputs)
    values = [*body.inputs, *body.initializers.values(), *made]
    for index, value in enumerate(values):
        value.name = f"piece{index}"
    for index, node in enumerate(body):
        node.name = f"node{index}"
        node.metadata_props.clear()
    return ir.Model(body, ir_version=IR_VERSION)


def run_piece(piece: ir.Model, feeds: Sequence[Array]) -> Array:
    """Run a piece of a graph; fused nodes are replaced by their bodies."""
    for node in list(piece.graph):
        if node.domain == OWN_DOMAIN:
            expand(node, opset=opset_of(piece), by="check")
    names = (str(value.name) for value in piece.graph.inputs)
    named = dict(zip(names, feeds, strict=True))
    (result,) = Session(piece, optimize=False).run(named).values()
    return result


def take_back(body: ir.Graph, made: Sequence[ir.Node], known: set[str]) -> None:
    """Remove nodes, in graph order, and all initializers but the known ones."""
    body.remove(reversed(made), safe=True)
    for name in [name for name in body.initializers if name not in known]:
        del body.initializers[name]


# Number of draws until a result is not zero: a single position lies outside the
# feature map in a third of all draws.
DRAWS = 8


Draw: TypeAlias = Callable[[np.random.Generator], Mapping[ir.Value, Array]]
"""Draws the inputs of two pieces."""


class Proofs:
    """Compares pieces of a graph on fresh random numbers, and caches equal pairs."""

    def __init__(self, opset: int, seed: int) -> None:
        self._opset, self._seed = opset, seed
        self._known: dict[tuple[str, str], float] = {}

    def error(
        self, before: ir.Value, after: ir.Value, draw: Draw, least: int = 1
    ) -> float:
        """Return max|a-b|/max|a| of two values that are computed from drawn inputs.

        At least ``least`` draws are compared, more while nothing but zeros comes out.

        Raises:
            PreconditionError: one of them reads another value too, or returns only
                zeros.
            GraphError: onnxruntime cannot run it.
        """
        random = np.random.default_rng(self._seed)
        drawn, apart, largest = draw(random), 0.0, 0.0
        pieces = [piece_of(value, [*drawn], self._opset) for value in (before, after)]
        key = (digest(pieces[0]), digest(pieces[1]))
        if key in self._known:
            return self._known[key]
        for count in range(1, DRAWS + least):
            feeds = list(drawn.values())
            a, b = (run_piece(piece, feeds).astype(np.float64) for piece in pieces)
            apart = max(apart, float(np.abs(a - b).max()))
            largest = max(largest, float(np.abs(a).max()))
            if largest and count >= least:
                self._known[key] = apart / largest
                return self._known[key]
            drawn = draw(random)
        raise PreconditionError("nothing but zeros comes out of random numbers")


def draw_views(
    views: Sequence[View], random: np.random.Generator
) -> dict[ir.Value, Array]:
    """Draw normal numbers; a third of the positions lie outside the feature maps."""
    return {view.value: _draw(view, random) for view in views}


def _draw(view: View, random: np.random.Generator) -> Array:
    shape, kind = sizes(view.layout), (view.value.dtype or ir.DataType.FLOAT).numpy()
    if not any(digit.axis == XY for digit in flat(view.layout)):
        return random.standard_normal(shape).astype(kind)
    places = random.uniform(-1 - 2 * OUTSIDE, 1 + 2 * OUTSIDE, shape)
    return ((places - view.shift) / view.scale).astype(kind)
