"""The rule set ``safe``: geometry, positions, attention weights and ego status."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.quantization.rules.base import Rule, RuleFacts
from me2e_compress.quantization.rules.cost_rule import CostGate
from me2e_compress.quantization.rules.kernel_rules import (
    NarrowConvolution,
    SmallProduct,
)
from me2e_compress.quantization.rules.paper_rules import PaperRules


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
        """Object to what :func:`~me2e_compress.quantization.coordinates` found."""
        return facts.coordinates.get(node)


@dataclasses.dataclass(frozen=True)
class EgoInput(Rule):
    """Small encoders of the ego car's status stay float.

    They cost nothing, and of 106 modules of SparseDrive that NVIDIA measured, the
    status encoder lost most in int8: over four times as much as the next.
    """

    name: ClassVar[str] = "ego-input"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to what :func:`~me2e_compress.quantization.ego_inputs` found."""
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
        without: names of rules that are switched off, e.g. ``gemv``.
        extra: more rules, asked last.
    """

    name: ClassVar[str] = "safe"
    share_concat: ClassVar[bool] = True

    def own_rules(self) -> tuple[Rule, ...]:
        """Return rules of operators, safety, the paper's stages, kernels and cost."""
        operator, _, module, weight, length, vector = super().own_rules()
        return (
            *(operator, module, weight),
            *(Geometry(), Coordinates(), EgoInput()),
            *(length, AttentionWeights(), vector),
            *(SmallProduct(), NarrowConvolution(), CostGate()),
        )


@dataclasses.dataclass(frozen=True)
class TensorRTRules(SafeRules):
    """The rule set ``safe`` by its former name: the same plan.

    Attributes:
        attention_limit: longest attention that the paper's stage 1 would make int8,
            in tokens; without ``attention-weights`` it counts.
        without: names of rules that are switched off, e.g. ``gemv``.
        extra: more rules, asked last.
    """

    name: ClassVar[str] = "tensorrt"
