"""The rule set ``safe``: what a model drives by, what kernels are too coarse for, cost.

Bounds of int8 kernels are those of NVIDIA's own quantizer (ModelOpt 0.47,
``modelopt/onnx/quantization/graph_utils.py``): int8 tensor cores work on tiles of 16
and on channels in groups of 8, and a layer that fills neither is padded until it is
slower than in half precision.
"""

import dataclasses
from collections.abc import Collection, Mapping
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.calibration.observers import DEFAULT_METHOD
from me2e_compress.graph import CONVOLUTIONS, static_shape
from me2e_compress.graph.shapes import PRODUCTS, extent
from me2e_compress.quantization.rules.base import Rule, RuleFacts
from me2e_compress.quantization.rules.paper_rules import PaperRules


@dataclasses.dataclass(frozen=True)
class CostGate(Rule):
    """Int8 that takes longer than float on the target stays float.

    Int8 saves arithmetic, which grows with a layer's multiply-accumulates, and costs
    time where it begins and ends, which grows with the tensors there. Both are
    estimated by the target; a target that estimates nothing keeps everything.
    """

    name: ClassVar[str] = "cost"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to nothing: what a node costs depends on its neighbours."""
        return None

    def objections(
        self, int8: Collection[ir.Node], facts: RuleFacts
    ) -> Mapping[ir.Node, str]:
        """Object to the layers that pay more at their borders than they save."""
        costs = None if facts.costs is None else facts.costs(facts.model, int8)
        if costs is None:
            return {}
        losses = costs.losses(int8)
        return {node: f"{loss} on {costs.machine}" for node, loss in losses.items()}


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


@dataclasses.dataclass(frozen=True)
class Geometry(Rule):
    """What multiplies camera matrices, poses, points, pixels or metres stays float.

    One scale for pixel coordinates of thousands, or for metres and a homogeneous 1,
    leaves steps of tens of pixels: the features are sampled elsewhere. On VAD-tiny the
    projection by ``lidar2img`` alone takes the BEV from 19 dB to 0.
    """

    name: ClassVar[str] = "geometry"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to what :func:`~me2e_compress.quantization.geometry` found."""
        return facts.geometry.get(node)


@dataclasses.dataclass(frozen=True)
class Coordinates(Rule):
    """Layers that positions come from stay float: offsets, reference points.

    A position is right to a fraction of a cell or wrong; 8 bits over a map of 100
    cells leave half a cell. Sampling weights that read the same tensor as the offsets
    go with them: neither then needs it in int8.
    """

    name: ClassVar[str] = "coordinates"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to what :func:`~me2e_compress.quantization.geometry` found."""
        return facts.coordinates.get(node)


@dataclasses.dataclass(frozen=True)
class EgoInput(Rule):
    """Small encoders of the ego car's status stay float.

    They cost nothing, and of 106 modules of SparseDrive that NVIDIA measured, the
    status encoder lost most in int8: over four times as much as the next.
    """

    name: ClassVar[str] = "ego-input"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to what :func:`~me2e_compress.quantization.rules.base` found."""
        source = facts.ego_layers.get(node)
        return None if source is None else f"encodes the ego status {source}"


@dataclasses.dataclass(frozen=True)
class AttentionWeights(Rule):
    """Attention weights are never int8: what a softmax gives is read as float.

    Weights of many tokens are small numbers beside a few large ones, and most round to
    zero. The product that the softmax reads goes with the one that reads the softmax:
    TensorRT fuses both, in one precision.
    """

    name: ClassVar[str] = "attention-weights"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to both products of an attention, and to other readers of weights."""
        return facts.attention_weights.get(node)


@dataclasses.dataclass(frozen=True)
class SafeRules(PaperRules):
    """The paper's rules and the limits of kernels; what a model drives by stays float.

    Geometry, positions, attention weights and ego status stay float; the default of
    every target.

    Attributes:
        attention_limit: longest attention that the paper's stage 1 would make int8, in
            tokens; without ``attention-weights`` it counts.
        balance: as in every rule set; here weights are balanced unless it is off.
    """

    name: ClassVar[str] = "safe"
    share_concat: ClassVar[bool] = True
    method: ClassVar[str] = DEFAULT_METHOD
    balance: bool = dataclasses.field(default=True, kw_only=True)

    def own_rules(self) -> tuple[Rule, ...]:
        """Return rules of operators, safety, the paper's stages, kernels and cost."""
        operator, _, module, weight, length, vector = super().own_rules()
        return (
            *(operator, module, weight),
            *(Geometry(), Coordinates(), EgoInput()),
            *(length, AttentionWeights(), vector),
            *(SmallProduct(), NarrowConvolution(), CostGate()),
        )
