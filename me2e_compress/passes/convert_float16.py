"""Convert a graph to float16 where that is as good as float32."""

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase

import numpy as np
import onnx_ir as ir

from me2e_compress.base.display import plural
from me2e_compress.base.errors import PreconditionError
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.graph import (
    array_of,
    has_subgraph,
    input_at,
    is_standard,
    opset_of,
    provenance,
    rewrite,
    static_shape,
)
from me2e_compress.graph.nodes import (
    LAYOUT_OPERATORS,
    Numbers,
    constant_values,
    producer_of,
)
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.convert_float32 import FLOAT, HALF, ElementTypes, Retyping
from me2e_compress.quantization.geometry import position_arithmetic
from me2e_compress.targets.quantized import (
    DEQUANTIZE,
    QUANTIZE,
    describe_quantized,
    pairs_of,
)
from me2e_compress.targets.weights import requantized, scales_in

# The first opset whose QuantizeLinear takes float16 and float16 scales.
SCALES_SINCE = 19


@dataclasses.dataclass(frozen=True)
class ConvertFloat16(Pass):
    """Compute in float16 where nothing is lost, with Casts at the borders.

    Given:   y = Conv(x, w, b)
             z = ReduceSum(y)

    Result:  y = Conv(Cast<float16>(x), w_half, b_half)
             z = ReduceSum(Cast<float>(y))

    These stay in float32: plugins and nodes with bodies; sums, squares and
    exponentials; softmax over more than 1,024 elements; choices and comparisons;
    positions and the arithmetic on them; constants that float16 cannot hold (masks of
    -1e9, epsilons of 1e-12); nodes that only move elements between two of these; and,
    with frames, nodes that read or make numbers beyond half of 65504.

    LayerNormalization sums in float32 internally. All operands of an operator have one
    type, as TensorRT's strongly typed networks require. An int8 graph becomes int8 and
    float16: its scales become float16, which needs opset 19.

    Attributes:
        keep: globs over nodes that stay in float32, by name, operator or module.
    """

    name = "convert-float16"
    exact = False
    keep: tuple[str, ...] = ()

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Choose the nodes, then change their type."""
        if describe_quantized(model) and opset_of(model) < SCALES_SINCE:
            raise PreconditionError(
                f"the int8 graph is of opset {opset_of(model)}: float16 scales need"
                f" {SCALES_SINCE}, export the model so"
            )
        # Collect the nodes that must stay in float32
        types = ElementTypes(FLOAT, HALF, opset_of(model))
        wide = _float32_nodes(model, types, context)
        for pattern in self.keep:
            wide |= dict.fromkeys(_matches(model, pattern), "the option keeps it")
        # Everything else that can be float16 becomes float16
        narrow = [n for n in model.graph if n not in wide and types.inputs(n)]
        _raise_scales(model, set(narrow))
        changes = Retyping(model, types, self.name).retype(narrow)
        # Report why the others stay
        reasons = Counter(
            reason
            for node, reason in wide.items()
            if any(value is not None and value.dtype == FLOAT for value in node.inputs)
        )
        nodes, stay = plural(len(narrow), "node"), reasons.total()
        notes = [f"{nodes} in float16, {stay} stay in float32"]
        if reasons:
            listed = ", ".join(f"{why} {n}" for why, n in reasons.most_common())
            notes.append(f"float32: {listed}")
        if context.frames is None:
            notes.append(
                "no frames (--frames): whether all numbers fit float16 was not measured"
            )
        return PassResult(model, changes, tuple(notes))


def _matches(model: ir.Model, pattern: str) -> list[ir.Node]:
    """Return the nodes whose name, operator or module a glob matches; at least one."""
    nodes = [
        node
        for node in model.graph
        for words in [(node.name or "", node.op_type, provenance.module_of(node))]
        if any(fnmatchcase(word, pattern) for word in words)
    ]
    if not nodes:
        raise PreconditionError(f"keep: no node, operator or module is {pattern!r}")
    return nodes


# Choose the nodes that stay in float32.


# 65504.
LARGEST = float(np.finfo(np.float16).max)
# Factor by which other frames may exceed the measured range.
HEADROOM = 2.0
# A half has 11 bits: a sum of more than 2,048 equal numbers stops growing. A kernel
# that adds up a softmax in half is right to 1e-3 up to half of that.
LONGEST_SUM = 1024
# Relative error of a constant that still is the same constant.
_RESOLUTION = 2.0**-10

_POSITIONS = "positions: a half is right to 1/2048"
# Operators that stay in float32 whatever they read, by the reason.
_OPERATORS = {
    # Sums of many elements, squares and exponentials leave float16 on their way
    "sums, squares and exponentials": {
        "CumSum", "Exp", "Log", "Mean", "MeanVarianceNormalization", "Pow", "ReduceL1",
        "ReduceL2", "ReduceLogSum", "ReduceLogSumExp", "ReduceMean", "ReduceProd",
        "ReduceSum", "ReduceSumSquare", "Softplus", "Sum",
    },
    # Nearly equal numbers would become equal
    "choices between nearly equal numbers": {
        "ArgMax", "ArgMin", "Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual",
        "NonMaxSuppression", "NonZero", "TopK", "Ceil", "Floor", "Round",
    },
    # These take coordinates beside their data
    _POSITIONS: {"DeformConv", "Det", "GridSample", "Range", "RoiAlign"},
}  # fmt: skip
# What only moves elements: it is as exact in either type.
_MOVES = LAYOUT_OPERATORS | {
    "Concat", "Expand", "Gather", "GatherElements", "GatherND", "Pad",
    "ScatterElements", "ScatterND", "Slice", "Split", "Tile",
}  # fmt: skip


def _float32_nodes(
    model: ir.Model, types: ElementTypes, context: Context
) -> dict[ir.Node, str]:
    """Map the nodes of the main graph that must stay in float32 to the reason.

    Shapes and types must be inferred; without frames no ranges are measured.
    """
    # Operators, constants and positions decide without running the graph
    places = position_arithmetic(model, constant_values(model))
    reasons, opset = dict[ir.Node, str](), opset_of(model)
    for node in model.graph:
        reason = _by_operator(node, opset) or _by_constants(node, types)
        if reason is None and node in places:
            reason = _POSITIONS
        if reason is not None:
            reasons[node] = reason
    # Measured ranges and the nodes in between come last
    if context.frames is not None:
        reasons |= _by_ranges(model, types, reasons, context)
    return reasons | _between(model, reasons)


def _by_operator(node: ir.Node, opset: int) -> str | None:
    """Return why an operator stays in float32 whatever it reads, else None."""
    if not is_standard(node):
        return "not an operator of ONNX"
    if has_subgraph(node):
        return "has a body"
    for reason, op_types in _OPERATORS.items():
        if node.op_type in op_types:
            return reason
    if node.op_type in ("LogSoftmax", "Softmax"):
        shape = static_shape(node.inputs[0])
        if shape is None:
            return "a softmax of unknown length"
        # Before opset 13 it takes all axes from the given one on together
        axis = node.attributes.get_int("axis", 1 if opset < 13 else -1)
        if math.prod(shape[axis:] if opset < 13 else shape[axis:][:1]) > LONGEST_SUM:
            return f"a softmax over more than {LONGEST_SUM} elements"
    return None


def _by_constants(node: ir.Node, types: ElementTypes) -> str | None:
    for index in types.inputs(node):
        value = node.inputs[index]  # the default of an input counts as well
        tensor = None if value is None else ir.convenience.get_const_tensor(value)
        if tensor is not None and not _fits(tensor.numpy().astype(np.float64)):
            return "a constant that float16 does not hold"
    return None


def _fits(numbers: Numbers) -> bool:
    """Return whether constants are the same in float16.

    Of more than 16 numbers only the large ones count: the rest may become 0.
    """
    size = np.abs(numbers)
    if numbers.size == 0 or not np.isfinite(size).all():
        return True
    if size.max() > LARGEST:
        return False
    error = np.abs(numbers.astype(np.float16).astype(np.float64) - numbers)
    scale = size if numbers.size <= 16 else size.max()
    return bool((error <= _RESOLUTION * scale).all())


def _by_ranges(
    model: ir.Model, types: ElementTypes, known: Collection[ir.Node], context: Context
) -> dict[ir.Node, str]:
    """Map the nodes that read or make too large numbers on the frames to the size."""
    # Map the measured values to the nodes that touch them
    touched, constants = dict[str, list[ir.Node]](), constant_values(model)
    for node in model.graph:
        if node in known:
            continue
        read = [node.inputs[index] for index in types.inputs(node)]
        made = [node.outputs[index] for index in types.outputs(node)]
        for value in (*read, *made):
            if value is not None and value not in constants:
                touched.setdefault(str(value.name), []).append(node)
    if not touched or context.frames is None:
        return {}
    calibrator = Calibrator(provider=context.provider)
    ranges = calibrator.run(model, tuple(touched), context.frames).tensors
    # Keep a factor of headroom for frames that were not measured
    reaches = {name: max(-low, high) for name, (low, high) in ranges.items()}
    return {
        node: f"numbers up to {reach:.3g}"
        for name, reach in reaches.items()
        if reach * HEADROOM > LARGEST
        for node in touched[name]
    }


def _between(model: ir.Model, wide: Mapping[ir.Node, str]) -> dict[ir.Node, str]:
    """Find nodes that only move elements between float32 nodes, inputs and outputs."""
    # Begin with all of them: a chain of moves stays as a whole
    moves = {node: None for node in model.graph if node.op_type in _MOVES}

    def stays(neighbours: Iterable[ir.Node | None]) -> bool:
        return all(n is None or n in wide or n in moves for n in neighbours)

    def from_wide(node: ir.Node) -> bool:
        data = node.inputs if node.op_type == "Concat" else node.inputs[:1]
        return stays(producer_of(value) for value in data)

    def to_wide(node: ir.Node) -> bool:
        return stays(itertools.chain(*(v.consumers() for v in node.outputs)))

    # Strike out moves next to float16 nodes until nothing changes
    before = -1
    while len(moves) != before:
        before = len(moves)
        for node in list(moves):
            if not from_wide(node):
                del moves[node]
        for node in reversed(list(moves)):
            if not to_wide(node):
                del moves[node]
    return dict.fromkeys(moves, "moves numbers between nodes in float32")


def _raise_scales(model: ir.Model, narrow: set[ir.Node]) -> None:
    """Raise int8 scales too small for float16, and round their stored integers again.

    Given:   y = DequantizeLinear(q, s)              s float32 [channels], some 1e-9
    Result:  y = DequantizeLinear(q', s')            s' at least 6e-8, q' for s'

    A channel whose weights are nearly 0 has such scales; TensorRT refuses a scale of 0.
    Both nodes of a pair get the same scales, if one of them is ``narrow``. Nodes are
    changed in place; scales that fit float16 stay as they are.
    """
    names = rewrite.value_names(model.graph)
    fresh: dict[ir.Value, ir.Value] = {}
    for node in list(pairs_of(model)):
        scale, stored = node.inputs[1], array_of(node.inputs[1])
        if scale is None or stored is None or stored.dtype != np.float32:
            continue
        # Skip pairs of which neither node becomes float16
        partners: Sequence[ir.Node | None] = [producer_of(node.inputs[0])]
        if node.op_type == QUANTIZE:
            readers = node.outputs[0].consumers()
            partners = [reader for reader in readers if reader.op_type == DEQUANTIZE]
        if narrow.isdisjoint((node, *partners)):
            continue
        # Raise only subnormal scales: rounding others to 11 bits moves no integer
        exact = stored.astype(np.float32)
        few = (exact < np.finfo(np.float16).smallest_normal) & (exact > 0)
        raised = np.where(few, scales_in(exact, np.float16).astype(np.float32), exact)
        if np.array_equal(raised, exact):
            continue
        if scale not in fresh:
            name = f"{scale.name}_held"
            fresh[scale] = rewrite.add_constant(model.graph, raised, name, names)
        # Integers that are stored are rounded again
        value = node.inputs[0]
        integers = array_of(value)
        if node.op_type == DEQUANTIZE and integers is not None and value is not None:
            axis = node.attributes.get_int("axis", 1) if exact.size > 1 else None
            zero = array_of(input_at(node, 2))
            again = requantized(integers, exact, raised, axis, zero)
            name = f"{value.name}_held"
            rounded = rewrite.add_constant(model.graph, again, name, names)
            node.replace_input_with(0, rounded)
        node.replace_input_with(1, fresh[scale])
    rewrite.sweep(model)
