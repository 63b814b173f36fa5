"""Find what onnxruntime's CPU computes on uint8 and int8: layers, tensors, grids."""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Self

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.observers import scale_of
from me2e_compress.graph import bias_of, is_standard, producer_of, rank_of
from me2e_compress.graph.nodes import maker, scalar_of, sole_reader
from me2e_compress.graph.shapes import extent, is_one_matrix, open_shape, static_shape
from me2e_compress.operators import int8_inputs
from me2e_compress.targets.weights import is_bias

# Operators that pick or move elements: before quantization or behind it, on one grid,
# they give the same integers. A grid of their own would gain nothing.
MOVES = frozenset(
    {
        "Flatten", "MaxPool", "Reshape", "Resize", "Slice", "SpaceToDepth", "Squeeze",
        "Transpose", "Unsqueeze",
    }
)  # fmt: skip

# Operators whose output may be a small part of the input's range: it has a grid of its
# own
AVERAGES = frozenset({"AveragePool", "GlobalAveragePool"})

LAYERS = ("Conv", "Gemm", "MatMul")  # operators with a weight that have an int8 kernel

# Operators that read several activations, each on its own grid
JOINS = frozenset({"Add", "Concat"})


def objection(node: ir.Node) -> str | None:
    """Explain why a layer has no int8 kernel; None if it has one."""
    # There is QLinearConv, but none for ConvTranspose; QGemm has neither beta nor a
    # transposed left operand; MatMul must have one weight for the whole batch
    if not is_standard(node) or node.op_type not in LAYERS:
        return f"there is no int8 kernel for {node.op_type}"
    # Each operator has its own conditions
    bias = bias_of(node)
    if node.op_type == "Conv":
        if bias is not None and graph.array_of(bias) is None:
            return "the bias is computed"
        reader = None if reads_one_pixel(node) else _magnifier(end_of(node))
        return reader and f"it writes uint8, whose rounding {reader} magnifies"
    if node.op_type == "Gemm":
        factors = [node.attributes.get_float(name, 1.0) for name in ("alpha", "beta")]
        if factors != [1.0, 1.0]:
            return "QGemm takes neither alpha nor beta"
        if node.attributes.get_int("transA", 0):
            return "QGemm takes no transposed left operand (transA)"
        if bias is None or is_bias(bias, 2, extent(node, weight=True).columns):
            return None
        return "QGemm takes one bias for all rows"
    if (rank_of(node.inputs[0]) or 0) < 2:
        return "the left operand is a vector, or of unknown rank"
    return None if is_one_matrix(node) else "the weight is a batch of matrices"


_MAGNIFIERS = ("Log", "Pow", "Reciprocal")


def _magnifier(value: ir.Value) -> str | None:
    """Name an operator that makes a small error of what it reads a large one."""
    # A QLinearConv writes uint8 of one scale, as TensorRT's convolution need not: small
    # values keep few steps of it, and a logarithm, a quotient or a square lives on them
    for use in value.uses():
        reader = use.node
        squares = reader.op_type == "Mul" and reader.inputs[0] is reader.inputs[1]
        divides = reader.op_type == "Div" and use.idx == 1
        magnifies = reader.op_type in _MAGNIFIERS or squares or divides
        if magnifies and is_standard(reader):
            return f"{reader.name} ({reader.op_type})"
    return None


def reads_one_pixel(node: ir.Node) -> bool:
    """Return whether a convolution is a Gemm: kernels of 1 over images of one pixel."""
    # So it is behind a global average. A Gemm may write float; a QLinearConv may not.
    image, weight = open_shape(node.inputs[0]), static_shape(node.inputs[1])
    return (
        node.op_type == "Conv"
        and image is not None
        and weight is not None
        and set(image[2:]) == set(weight[2:]) == {1}
        and node.attributes.get_int("group", 1) == 1
        and not any(node.attributes.get_ints("pads", []))
    )


def is_move(node: ir.Node) -> bool:
    """Return whether a node only moves or picks elements of its first input."""
    if not is_standard(node) or node.op_type not in MOVES:
        return False
    if node.op_type == "Resize":
        mode = node.attributes.get_string("mode", "nearest")
        places = node.attributes.get_string("coordinate_transformation_mode")
        # Outside the crop there is a value of the attributes, not of the input.
        return mode == "nearest" and places != "tf_crop_and_resize"
    return len(node.outputs) == 1


def is_average(node: ir.Node) -> bool:
    """Return whether a node averages its input over windows, or over all places."""
    return is_standard(node) and node.op_type in AVERAGES


def has_average_kernel(node: ir.Node) -> bool:
    """Return whether the int8 kernel of an average computes what ONNX defines."""
    # onnxruntime 1.31 refuses a QLinearAveragePool with dilations, of 1 too. With
    # `count_include_pad` and `ceil_mode`, windows that reach beyond the padding are
    # divided by all their places; ONNX leaves those out that are beyond.
    options = node.attributes
    dilated = "dilations" in options
    beyond = all(options.get_int(n, 0) for n in ("ceil_mode", "count_include_pad"))
    return is_average(node) and not dilated and not beyond


def end_of(node: ir.Node) -> ir.Value:
    """Return the output of a layer's kernel: that of the ReLU after it, if any."""
    # A ReLU costs nothing where its uint8 grid begins at zero: quantization clips
    reader = sole_reader(node.outputs[0])
    if reader is not None and is_clip_at_zero(reader):
        return reader.outputs[0]
    return node.outputs[0]


def is_clip_at_zero(node: ir.Node) -> bool:
    """Return whether a node is a ReLU, or a Clip that begins at zero."""
    if node.op_type == "Clip":
        return is_standard(node) and scalar_of(graph.input_at(node, 1)) == 0.0
    return is_standard(node) and node.op_type == "Relu"


# Find the int8 part of a graph: its uint8 tensors and their grids.


MIDDLE = 128  # the uint8 zero point of a signed tensor: int8 value plus 128

# Ranges so many times as wide on one side of zero as on the other have uint8 steps a
# quarter smaller, or less, than those of int8: 2.5 dB to 6
LOPSIDED = 2.0

_UNSIGNED = frozenset(
    {"Abs", "Exp", "HardSigmoid", "Sigmoid", "Softmax", "Softplus", "Sqrt"}
)


@dataclasses.dataclass(frozen=True)
class Region:
    """The int8 part of a graph.

    ``grids`` has the uint8 tensors, and the tensor whose range is theirs: usually their
    own, or the first of a chain that only moves elements.
    """

    layers: dict[ir.Node, ir.Value]  # with the uint8 tensors that they read
    grids: dict[ir.Value, ir.Value]
    written: frozenset[ir.Value]  # by an int8 kernel, so that no float version exists
    readers: frozenset[ir.Node]  # that read uint8, other than layers
    sampled: dict[ir.Node, ir.Node] = dataclasses.field(default_factory=dict)

    @property
    def ranged(self) -> tuple[str, ...]:
        """The tensors whose range must be known."""
        return tuple(dict.fromkeys(str(value.name) for value in self.grids.values()))

    def reads(self, node: ir.Node, index: int) -> bool:
        """Return whether a node reads an input as uint8, where the tensor has one."""
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
        and objection(node) is None
    }
    # Layers read uint8 in any case; the walk adds what follows.
    grids = {value: value for value in layers.values()}
    written: set[ir.Value] = set()
    readers: set[ir.Node] = set()
    sampled: dict[ir.Node, ir.Node] = {}
    sampling = {n for n in graph if n.outputs[0].name in chosen and int8_inputs(n)}
    wanted = {_sampled(node, ())[0] for node in sampling}
    averages = _averages(graph, layers, wanted)
    convolutions = {n for n in layers if n.op_type == "Conv" and not reads_one_pixel(n)}
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
            and all(value in grids for value in node.inputs)
            and any(value in written for value in node.inputs)
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
    graph: ir.Graph, layers: Mapping[ir.Node, ir.Value], sampled: Collection[ir.Value]
) -> set[ir.Node]:
    """Find the averages that nothing but int8 kernels reads, directly or moved."""
    # Other readers get the float average: rounding it would cost them more than the
    # time that it saves
    inputs = {*layers.values(), *sampled}
    only: set[ir.Node] = set()

    def is_int8(reader: ir.Node, index: int) -> bool:
        first = index == 0 and (reader in layers or reader in only)
        return first or (reader.op_type in JOINS and end_of(reader) in inputs)

    # Readers are decided before what they read
    for node in reversed(graph):
        if not (has_average_kernel(node) or is_move(node)):
            continue
        value = node.outputs[0]
        others = any(not is_int8(use.node, use.idx) for use in value.uses())
        if value in sampled or not (others or value.is_graph_output()):
            only.add(node)
    return {node for node in only if is_average(node)}


def _sampled(node: ir.Node, written: Collection[ir.Value]) -> tuple[ir.Value, ir.Node]:
    """Return what a fused operator samples through reshapes, and its reader."""
    value = node.inputs[0]
    assert value is not None
    # Look through reshapes with one reader.
    while value not in written and len(value.uses()) == 1:
        producer = maker(value, "Reshape")
        if producer is None or producer.inputs[0] is None:
            break
        value, node = producer.inputs[0], producer
    return value, node


@dataclasses.dataclass(frozen=True)
class Grid:
    """The uint8 grid of one tensor: ``value = scale * (uint8 - zero)``.

    ``zero`` is 128 for a signed tensor, 0 for one that is never negative.
    """

    scale: np.float32
    zero: int

    @classmethod
    def of(cls, value: ir.Value, low: float, high: float) -> Self:
        """Return the grid of a tensor with a range."""
        # A signed tensor keeps the plan's symmetric int8 grid exactly, moved up by 128:
        # onnxruntime's kernels process uint8 activations 10 to 40 times faster than
        # int8 ones on processors with VNNI, whatever the zero point. Where one side of
        # the range is `LOPSIDED` times the other, as behind a SiLU or GELU, that grid
        # wastes up to half of its steps; here the range with zero is divided into 255
        # of them. Where a tensor is never negative, the kernel's clipping replaces a
        # ReLU.
        low = 0.0 if never_negative(value) else min(low, 0.0)
        high = max(high, 0.0)
        narrow, wide = sorted((-low, high))
        if wide < LOPSIDED * narrow:
            return cls(scale_of(low, high), MIDDLE)
        # 255 steps from low to high; low is uint8 0, so 0.0 is -low / step
        step = np.float32((high - low) / 255) or np.float32(1)
        return cls(step, round(-low / float(step)))


def never_negative(value: ir.Value) -> bool:
    """Prove from its producers, in linear time, that a tensor is never negative."""
    pending: list[ir.Value | None] = [value]
    visited: set[ir.Value] = {value}
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
        pending += [source for source in sources if source not in visited]
        visited.update(source for source in sources if source is not None)
    return True
