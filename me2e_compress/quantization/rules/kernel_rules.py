"""Rules of int8 kernels: which layers are too small for them.

Bounds are those of NVIDIA's own quantizer (ModelOpt 0.47,
``modelopt/onnx/quantization/graph_utils.py``): int8 tensor cores work on tiles of 16
and on channels in groups of 8, and a layer that fills neither is padded until it is
slower than in half precision.
"""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph import CONVOLUTIONS, static_shape
from me2e_compress.graph.shapes import PRODUCTS, extent
from me2e_compress.quantization.rules.base import Rule, RuleFacts


@dataclasses.dataclass(frozen=True)
class SmallProduct(Rule):
    """A product whose inner or outer dimension is below one tile stays float.

    Attributes:
        minimum: smallest inner and outer dimension, in elements.
    """

    minimum: int = 16
    name: ClassVar[str] = "small-product"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object if K or N is below the minimum."""
        if node.op_type not in PRODUCTS:
            return None
        size = extent(node, weight=node.inputs[1] in facts.constants)
        for name, found in (("K", size.depth), ("N", size.columns)):
            if found is not None and found < self.minimum:
                return f"{name} = {found}, below {self.minimum}: less than one tile"
        return None


@dataclasses.dataclass(frozen=True)
class NarrowConvolution(Rule):
    """A convolution of few channels stays float, unless a kernel takes it as it is.

    Below ``minimum`` channels on either side (inputs counted within a group), it is
    int8 only if ungrouped with a square kernel, one side a multiple of ``packing`` and
    one side wide enough or the input an image; or grouped with outputs a multiple of
    ``packing`` and every kernel dimension at least 3.

    Attributes:
        minimum: channels on either side that any kernel takes.
        packing: channels that a kernel reads together.
    """

    minimum: int = 16
    packing: int = 8
    name: ClassVar[str] = "narrow-convolution"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to narrow convolutions without a kernel."""
        shape = static_shape(node.inputs[1])
        if node.op_type not in CONVOLUTIONS or shape is None:
            return None
        group = node.attributes.get_int("group", 1)
        inputs, outputs = shape[1], shape[0]
        if node.op_type == "ConvTranspose":
            inputs, outputs = shape[0] // group, shape[1] * group
        if min(inputs, outputs) >= self.minimum:
            return None
        # narrow layers that some kernel takes
        kernel = shape[2:]
        if group > 1:
            fits = outputs % self.packing == 0 and min(kernel, default=1) >= 3
        else:
            first = node.inputs[0] is not None and node.inputs[0].is_graph_input()
            packed = 0 in (inputs % self.packing, outputs % self.packing)
            wide = first or max(inputs, outputs) >= self.minimum
            fits = packed and wide and len(set(kernel)) == 1
        if fits:
            return None
        return (
            f"{inputs} to {outputs} channels in {group} groups, kernel {list(kernel)}:"
            " too narrow for int8 kernels"
        )
