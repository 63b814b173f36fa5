"""Find the int8 part of a graph: its uint8 tensors and their grids."""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Self

import numpy as np
import onnx_ir as ir

from me2e_compress.calibration.observers import scale_of
from me2e_compress.graph import is_standard, producer_of
from me2e_compress.operators import int8_inputs
from me2e_compress.targets.onnxruntime.kernels import (
    JOINS,
    end_of,
    has_average_kernel,
    has_kernel,
    is_average,
    is_clip_at_zero,
    is_move,
    reads_one_pixel,
)

MIDDLE = 128
"""The uint8 zero point of a signed tensor: int8 value plus 128."""

_UNSIGNED = frozenset(
    {"Abs", "Exp", "HardSigmoid", "Sigmoid", "Softmax", "Softplus", "Sqrt"}
)


@dataclasses.dataclass(frozen=True)
class Region:
    """The int8 part of a graph.

    Attributes:
        grids: the uint8 tensors, and the tensor whose range each one uses: usually its
            own, or the first of a chain that only moves elements.
        written: tensors that an int8 kernel writes, so that no float version exists.
        readers: nodes that read uint8, other than layers.
        sampled: fused operators that sample uint8, by the first node that reads it.
    """

    layers: dict[ir.Node, ir.Value]
    grids: dict[ir.Value, ir.Value]
    written: frozenset[ir.Value]
    readers: frozenset[ir.Node]
    sampled: dict[ir.Node, ir.Node] = dataclasses.field(default_factory=dict)

    @property
    def ranged(self) -> tuple[str, ...]:
        """The tensors whose range must be known."""
        return tuple(dict.fromkeys(str(each.name) for each in self.grids.values()))

    def reads(self, node: ir.Node, index: int) -> bool:
        """Return whether a node reads an input as uint8 where that exists."""
        if node in self.readers:
            return index == 0 or node.op_type in JOINS
        return (node in self.layers or node in self.sampled) and index == 0


def find_region(graph: ir.Graph, chosen: Collection[str]) -> Region:
    """Grow the int8 part of a graph from its layers, in one walk.

    * A layer reads uint8. A convolution also writes it, because QLinearConv cannot
      write anything else; a matrix product may write float (QGemm does), and so may a
      convolution of one pixel, which becomes one.
    * Nodes that only move elements (MaxPool, nearest Resize, layout) stay in uint8.
    * An average stays, on its own grid, if nothing but int8 kernels reads it.
    * An Add or Concat of uint8 tensors stays if a convolution wrote one of them and a
      layer reads the result: the residual branches and merges of a backbone or neck.
      The sums around a LayerNorm join two float tensors and stay float.
    * A fused operator samples uint8, through the Reshapes before it: its kernel reads
      the integers directly.

    ``graph`` is float everywhere and in topological order. ``chosen`` has the first
    outputs of the layers and fused operators to quantize; layers without a kernel are
    left out.
    """
    layers = {
        node: node.inputs[0]
        for node in graph
        if node.outputs[0].name in chosen
        and node.inputs[0] is not None
        and has_kernel(node)
    }
    # Layers read uint8 in any case; the walk adds what follows.
    grids = {value: value for value in layers.values()}
    written: set[ir.Value] = set()
    readers: set[ir.Node] = set()
    sampled: dict[ir.Node, ir.Node] = {}
    sampling = {n for n in graph if n.outputs[0].name in chosen and int8_inputs(n)}
    wanted = {_sampled(node, ())[0] for node in sampling}
    averages = _averages(graph, layers, wanted)
    convolutions = {
        layer
        for layer in layers
        if layer.op_type == "Conv" and not reads_one_pixel(layer)
    }
    # One walk in topological order: inputs are decided first.
    for node in graph:
        first = node.inputs[0] if node.inputs else None
        end = end_of(node)
        if node in convolutions:
            grids[end] = end
            written.add(end)
        elif first in written and (node in averages or is_move(node)):
            value = node.outputs[0]
            grids[value] = value if node in averages else grids[first]
            written.add(value)
            readers.add(node)
        elif (
            node.op_type in JOINS
            and (end in grids or end in wanted)
            and _joins(node, grids, written)
        ):
            grids[end] = end
            written.add(end)
            readers.add(node)
        elif node in sampling:
            value, reader = _sampled(node, written)
            grids.setdefault(value, value)
            sampled[reader] = node
    return Region(layers, grids, frozenset(written), frozenset(readers), sampled)


def _averages(
    graph: ir.Graph,
    layers: Mapping[ir.Node, ir.Value],
    sampled: Collection[ir.Value],
) -> set[ir.Node]:
    """Find the averages that nothing but int8 kernels reads, directly or moved.

    Other readers get the float average: rounding it would cost them more than the time
    that it saves.
    """
    inputs = {*layers.values(), *sampled}
    only: set[ir.Node] = set()
    # Readers are decided before what they read.
    for node in reversed(graph):
        if not (has_average_kernel(node) or is_move(node)):
            continue
        value = node.outputs[0]
        others = [
            use
            for use in value.uses()
            if not (use.idx == 0 and (use.node in layers or use.node in only))
            and not (use.node.op_type in JOINS and end_of(use.node) in inputs)
        ]
        if value in sampled or not (others or value.is_graph_output()):
            only.add(node)
    return {node for node in only if is_average(node)}


def _sampled(node: ir.Node, written: Collection[ir.Value]) -> tuple[ir.Value, ir.Node]:
    """Return what a fused operator samples through reshapes, and its reader."""
    value = node.inputs[0]
    assert value is not None
    # Look through reshapes with one reader.
    while value not in written and len(value.uses()) == 1:
        made = value.producer()
        if made is None or made.op_type != "Reshape" or made.inputs[0] is None:
            break
        value, node = made.inputs[0], made
    return value, node


def _joins(
    node: ir.Node, grids: Collection[ir.Value], written: Collection[ir.Value]
) -> bool:
    return all(each in grids for each in node.inputs) and any(
        each in written for each in node.inputs
    )


@dataclasses.dataclass(frozen=True)
class Grid:
    """The uint8 grid of one tensor: ``value = scale * (uint8 - zero)``.

    ``zero`` is 128 for a signed tensor, 0 for one that is never negative.
    """

    scale: np.float32
    zero: int

    @classmethod
    def of(cls, value: ir.Value, reach: float) -> Self:
        """Return the grid of a tensor whose largest magnitude is ``reach``.

        A signed tensor keeps the plan's symmetric int8 grid exactly, moved up by 128:
        onnxruntime's kernels process uint8 activations 10 to 40 times faster than int8
        ones on processors with VNNI. For a tensor that can never be negative the int8
        grid wastes its lower half; here its range [0, reach] is divided into 255 steps,
        not 127, and the kernel's clipping replaces a ReLU before it.
        """
        if never_negative(value):
            step = np.float32(reach / 255)
            return cls(step if step > 0 else np.float32(1), 0)
        return cls(scale_of(-reach, reach), MIDDLE)


def never_negative(value: ir.Value) -> bool:
    """Prove from its producers, in linear time, that a tensor is never negative."""
    pending: list[ir.Value | None] = [value]
    seen: set[ir.Value] = {value}
    while pending:
        node = producer_of(pending.pop())
        if node is None:
            return False
        if is_clip_at_zero(node) or (is_standard(node) and node.op_type in _UNSIGNED):
            continue
        # Moves, averages and joins pass the question on to their inputs.
        joins = is_standard(node) and node.op_type == "Concat"
        if not (joins or is_move(node) or is_average(node)):
            return False
        sources = node.inputs if joins else node.inputs[:1]
        pending += [each for each in sources if each not in seen]
        seen.update(each for each in sources if each is not None)
    return True
