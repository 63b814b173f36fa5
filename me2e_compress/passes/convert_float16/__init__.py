"""Convert a graph to float16 where that is as good as float32."""

import dataclasses
from collections import Counter
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.display import counted
from me2e_compress.errors import PreconditionError
from me2e_compress.graph import array_of, input_at, opset_of, rewrite
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.convert_float16.element_types import (
    FLOAT,
    HALF,
    ElementTypes,
    Retyping,
)
from me2e_compress.passes.convert_float16.wide_nodes import matching, wide_nodes
from me2e_compress.targets.quantized import (
    DEQUANTIZE,
    QUANTIZE,
    describe_quantized,
    pairs_of,
)
from me2e_compress.targets.weights import requantized, scales_in

__all__ = [
    "ConvertFloat16",
    "hold_scales",
]


# Scales of int8 that float16 holds: none becomes 0, or loses its digits.


def hold_scales(model: ir.Model, narrow: set[ir.Node]) -> None:
    """Raise scales that float16 lacks, and round their stored integers again.

    Given:   y = DequantizeLinear(q, s)              s float32 [channels], some 1e-9
    Result:  y = DequantizeLinear(q', s')            s' at least 6e-8, q' for s'

    A channel whose weights are nearly 0 has such scales; TensorRT takes none of 0. Both
    nodes of a pair get the same ones, if one of them is ``narrow``. Nodes are changed
    in place; scales that float16 holds stay as they are.
    """
    names = rewrite.value_names(model.graph)
    fresh: dict[ir.Value, ir.Value] = {}
    for node in list(pairs_of(model)):
        scale, stored = node.inputs[1], array_of(node.inputs[1])
        if scale is None or stored is None or stored.dtype != np.float32:
            continue
        exact = stored.astype(np.float32)
        if narrow.isdisjoint((node, *_partners(node))):
            continue
        raised = scales_in(exact, np.float16).astype(np.float32)
        # Rounding to 11 bits moves no integer
        few = exact < np.finfo(np.float16).smallest_normal
        raised = np.where(few & (exact > 0), raised, exact)
        if np.array_equal(raised, exact):
            continue
        if scale not in fresh:
            fresh[scale] = rewrite.add_constant(
                model.graph, raised, f"{scale.name}_held", names
            )
        _round_again(model.graph, node, exact, raised, names)
        node.replace_input_with(1, fresh[scale])
    rewrite.sweep(model)


def _partners(node: ir.Node) -> list[ir.Node]:
    """Return the other nodes of a pair."""
    if node.op_type == QUANTIZE:
        readers = node.outputs[0].consumers()
        return [each for each in readers if each.op_type == DEQUANTIZE]
    maker = None if node.inputs[0] is None else node.inputs[0].producer()
    return [] if maker is None else [maker]


def _round_again(
    where: ir.Graph,
    node: ir.Node,
    exact: npt.NDArray[np.float32],
    raised: npt.NDArray[np.float32],
    names: set[str],
) -> None:
    """Round the integers that a DequantizeLinear reads, if they are stored."""
    stored = array_of(node.inputs[0])
    if node.op_type != DEQUANTIZE or stored is None or node.inputs[0] is None:
        return
    axis = node.attributes.get_int("axis", 1) if exact.size > 1 else None
    zero = array_of(input_at(node, 2))
    integers = requantized(stored, exact, raised, axis, zero)
    name = f"{node.inputs[0].name}_held"
    node.replace_input_with(0, rewrite.add_constant(where, integers, name, names))


SCALES_SINCE = 19
"""The first opset whose QuantizeLinear takes float16 and float16 scales."""


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
        keep_io: whether inputs, outputs and recurrent state stay in float32; else they
            are what reads and makes them.
        keep_ops: operators that stay in float32.
        keep_modules: modules that stay in float32.
        keep_nodes: globs over names of nodes that stay in float32.
    """

    name: ClassVar[str] = "convert-float16"
    exact: ClassVar[bool] = False
    keep_io: bool = True
    keep_ops: tuple[str, ...] = ()
    keep_modules: tuple[str, ...] = ()
    keep_nodes: tuple[str, ...] = ()

    @property
    def changes_interface(self) -> bool:  # type: ignore[override]
        """Whether inputs and outputs become float16."""
        return not self.keep_io

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Choose the nodes, then change their type."""
        for name in self.keep_modules:
            context.modules.module(name)
        if describe_quantized(model) and opset_of(model) < SCALES_SINCE:
            raise PreconditionError(
                f"the int8 graph is of opset {opset_of(model)}: float16 scales need"
                f" {SCALES_SINCE}, export the model so"
            )
        # Collect the nodes that must stay in float32
        types = ElementTypes(model, FLOAT, HALF)
        wide = matching(model, self.keep_ops, self.keep_modules, self.keep_nodes)
        frames, io = context.frames, self.keep_io
        found = wide_nodes(model, types, frames, keep_io=io, provider=context.provider)
        wide = found | wide
        # Everything else that can be float16 becomes float16
        narrow = [n for n in model.graph if n not in wide and types.inputs(n)]
        hold_scales(model, set(narrow))
        retyping = Retyping(model, types, self.name)
        retyping.run(narrow, keep_io=self.keep_io)
        return PassResult(model, retyping.changed, _notes(narrow, wide, context))


def _notes(
    narrow: list[ir.Node], wide: dict[ir.Node, str], context: Context
) -> tuple[str, ...]:
    floats = Counter(
        reason
        for node, reason in wide.items()
        if any(each is not None and each.dtype == FLOAT for each in node.inputs)
    )
    notes = [
        f"{counted(len(narrow), 'node')} in float16, {floats.total()} stay in float32"
    ]
    if floats:
        listed = ", ".join(f"{reason} {n}" for reason, n in floats.most_common())
        notes.append(f"float32: {listed}")
    if context.frames is None:
        notes.append(
            "no frames (--frames): whether all numbers fit float16 was not measured"
        )
    return tuple(notes)
