"""Convert a graph to float16 where that is as good as float32."""

import dataclasses
from collections import Counter
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.display import counted
from me2e_compress.errors import PreconditionError
from me2e_compress.graph import opset_of
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.convert_float16.element_types import (
    FLOAT,
    HALF,
    ElementTypes,
    Retyping,
)
from me2e_compress.passes.convert_float16.scales import hold_scales
from me2e_compress.passes.convert_float16.wide_nodes import matching, wide_nodes
from me2e_compress.targets.quantized import describe_quantized

__all__ = ["ConvertFloat16"]

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
