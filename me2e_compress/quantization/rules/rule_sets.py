"""The two rule sets: the paper's operators, modules and stages, and ``safe``."""

import dataclasses
import math
from collections.abc import Collection, Mapping
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.calibration.observers import DEFAULT_METHOD
from me2e_compress.graph import (
    CONVOLUTIONS,
    WEIGHTED,
    is_standard,
    provenance,
    static_shape,
)
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, producer_of
from me2e_compress.graph.shapes import PRODUCTS, extent
from me2e_compress.operators import int8_inputs
from me2e_compress.quantization.find_attention import is_fused
from me2e_compress.quantization.rules import Rule, RuleFacts, RuleSet


@dataclasses.dataclass(frozen=True)
class WeightedOperator(Rule):
    """Convolutions and matrix products may be int8, and features that are sampled."""

    name: ClassVar[str] = "operator"
    firm: ClassVar[bool] = True

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to every other operator, and to what the target cannot read."""
        if is_standard(node) and node.op_type in WEIGHTED:
            return None
        if int8_inputs(node):
            return None if facts.fused is None else facts.fused(node)
        if node not in facts.attention:
            return f"{node.op_type} is not a weighted layer"
        if not is_fused(node):
            return f"{node.op_type} in an attention has no int8 kernel"
        size = facts.attention[node]
        return (
            f"{node.op_type} is a whole attention of {size.queries} queries and"
            f" {size.keys} keys, its products cannot be reached"
        )


@dataclasses.dataclass(frozen=True)
class FusedOperator(Rule):
    """Fused operators stay as they are, the features too that they sample."""

    name: ClassVar[str] = "fused-operator"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to every fused operator."""
        if not int8_inputs(node):
            return None
        return f"{node.op_type} is fused: only convolutions and products become int8"


@dataclasses.dataclass(frozen=True)
class ModuleScope(Rule):
    """Modules outside the scheme stay as they are."""

    name: ClassVar[str] = "module"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to a node of another module, or of none."""
        module = provenance.module_of(node)
        if module in facts.modules:
            return None
        return f"module {module or '(none)'} is not in the scheme"


@dataclasses.dataclass(frozen=True)
class WeightOperand(Rule):
    """The right operand is a weight in float32 or float16, or of an attention."""

    name: ClassVar[str] = "weight"
    firm: ClassVar[bool] = True

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to computed weights, constants on the left, other element types.

        And to what is quantized already, which stays as it is.
        """
        left, right = node.inputs[0], node.inputs[1]
        if stored := _integers(node, facts):
            return f"quantized already: it reads {stored}"
        if int8_inputs(node):
            if left is None or left in facts.constants:
                return "what it samples is constant"
            floats = left.dtype in (ir.DataType.FLOAT, None)
            return None if floats else "what it samples is not float32"
        # operands of floats, and not all constant
        types = {value.dtype for value in (left, right) if value is not None}
        if not types <= {ir.DataType.FLOAT, ir.DataType.FLOAT16, None}:
            return "neither float32 nor float16"
        if left in facts.constants and right in facts.constants:
            return "both operands are constant: computed once, when the graph is loaded"
        if left in facts.constants and node in facts.attention:
            return "the queries are constant"
        if left in facts.constants:
            return "the left operand is constant: coordinate arithmetic, not a layer"
        # a weight, or the product of an attention
        if right in facts.constants:
            return None
        if node.op_type != "MatMul":
            return "the weight is computed"
        if node in facts.attention:
            return None
        return "both operands are computed, and no softmax follows: not a layer"


def _integers(node: ir.Node, facts: RuleFacts) -> str:
    """Name the type of the integers that an operand is unpacked from; empty of floats.

    Between the DequantizeLinear and the layer may stand what moves elements and, behind
    a stored tensor, any arithmetic.
    """
    waiting = list(dict.fromkeys(node.inputs[:2]))
    for value in waiting:
        made = producer_of(value)
        if made is None:
            continue
        if made.op_type == "DequantizeLinear" and made.inputs[0] is not None:
            kind = made.inputs[0].dtype
            return "integers" if kind is None else kind.name.lower()
        if value in facts.constants or made.op_type in LAYOUT_OPERATORS:
            waiting += [value for value in made.inputs if value not in waiting]
    return ""


@dataclasses.dataclass(frozen=True)
class AttentionLength(Rule):
    """Stage 1: long attention stays float.

    TensorRT fuses int8 attention up to 512 queries and 512 keys, and errors of the
    product of queries and keys grow with the length in the softmax.

    Attributes:
        limit: longest attention that becomes int8, in tokens.
    """

    limit: int = 512
    name: ClassVar[str] = "attention-length"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object if queries or keys are more than the limit, or unknown in number."""
        attention = facts.attention.get(node)
        if attention is None:
            return None
        queries, keys = attention.queries, attention.keys
        if queries is None or keys is None:
            return f"attention of unknown length, limit {self.limit}"
        if max(queries, keys) <= self.limit:
            return None
        return f"attention of {queries} queries and {keys} keys, more than {self.limit}"


# Weights of a product of one row that int8 reads no faster: overheads are as long.
LEAST_READ = 2**16


@dataclasses.dataclass(frozen=True)
class MatrixVector(Rule):
    """Stage 2: a product that degenerates to GEMV gains nothing.

    Such a product takes the time of reading its weights. Where the target estimates
    costs, large parts of the model are read as int8 in 0.4 of it (onnxruntime 1.31, 1
    by 3,072 by 256); small convolutions of one pixel, products too, are slower so.

    Attributes:
        share: least part of the model's weights that become int8 so; None: none do.
    """

    name: ClassVar[str] = "gemv"
    share: float | None = None

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object if one side of the product is a single row or column."""
        if node.op_type == "Conv":
            image, weight = map(static_shape, node.inputs[:2])
            pixel = image and weight and math.prod(image) == weight[1]
            few = pixel and self._is_read(node, facts, 0, LEAST_READ - 1)
            return "few weights on one pixel: a matrix-vector product" if few else None
        if node.op_type not in PRODUCTS:
            return None
        size = extent(node, weight=node.inputs[1] in facts.constants)
        large = max(LEAST_READ, (self.share or 0) * facts.weight_elements)
        if not size.is_vector or self._is_read(node, facts, large):
            return None
        return f"{size.rows} rows by {size.columns} columns: a matrix-vector product"

    def _is_read(
        self, node: ir.Node, facts: RuleFacts, least: float, most: float = math.inf
    ) -> bool:
        """Return whether costs say how long so many constant weights are read."""
        shape, costs = static_shape(node.inputs[1]), facts.costs
        if self.share is None or shape is None or costs is None:
            return False
        holds = node.inputs[1] in facts.constants and least <= math.prod(shape) <= most
        return holds and costs(facts.model, ()) is not None


@dataclasses.dataclass(frozen=True)
class PaperRules(RuleSet):
    """The two stages of the paper alone, and what is no layer at all.

    Attributes:
        attention_limit: longest attention that becomes int8, in tokens.
    """

    name: ClassVar[str] = "paper"
    method: ClassVar[str] = "max-min"  # section III-C, equation 3
    attention_limit: int = 512

    def own_rules(self) -> tuple[Rule, ...]:
        """Return six rules, the stages last."""
        return (
            WeightedOperator(),
            FusedOperator(),
            ModuleScope(),
            WeightOperand(),
            AttentionLength(self.attention_limit),
            MatrixVector(),
        )


# The rule set ``safe``: what a model drives by, what kernels are too coarse for, cost.
#
# Bounds of int8 kernels are those of NVIDIA's own quantizer (ModelOpt 0.47,
# ``modelopt/onnx/quantization/graph_utils.py``): int8 tensor cores work on tiles of 16
# and on channels in groups of 8, and a layer that fills neither is padded until it is
# slower than in half precision.


@dataclasses.dataclass(frozen=True)
class CostGate(Rule):
    """Int8 that takes longer than float on the target stays float.

    Int8 saves arithmetic, which grows with a layer's multiply-accumulates, and costs
    time where it begins and ends, which grows with the tensors there. Both are
    estimated by the target; a target that estimates nothing keeps everything.
    """

    name: ClassVar[str] = "cost"

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
class FileSize(Rule):
    """Int8 that would make the file larger stays float.

    A weight that a float reader keeps would be stored twice, and a table that the graph
    computes would be written out.
    """

    name: ClassVar[str] = "size"

    def objections(
        self, int8: Collection[ir.Node], facts: RuleFacts
    ) -> Mapping[ir.Node, str]:
        """Object to the layers whose integers take more than the floats that go."""
        kept, objections = dict.fromkeys(int8), dict[ir.Node, str]()
        while True:
            more = {node: why for node in kept if (why := self._why(node, kept, facts))}
            if not more:
                return objections
            objections |= more
            kept = {node: None for node in kept if node not in more}

    def _why(
        self, node: ir.Node, int8: Collection[ir.Node], facts: RuleFacts
    ) -> str | None:
        """Compare what the int8 weight of a layer takes with the floats that go."""
        weight = node.inputs[1] if len(node.inputs) > 1 else None
        shape = static_shape(weight)
        if weight is None or weight not in facts.constants or shape is None:
            return None
        # the stored tensors that it is made of, and who else reads them
        stored, others, pending = 0, dict[ir.Node, None](), [weight]
        for value in pending:
            if value.const_value is None:
                made = value.producer()
                pending += [] if made is None else filter(None, made.inputs)
                continue
            readers = [
                use.node
                for use in value.uses()
                if not (use.node in int8 and use.idx == 1)
                and not set(use.node.outputs) <= set(facts.constants)
            ]
            others.update(dict.fromkeys(readers))
            stored += 0 if readers else value.const_value.nbytes
        # Integers are a byte each: no more than the floats that go
        if stored >= math.prod(shape):
            return None
        if others:
            names = ", ".join(str(reader.name) for reader in others)
            return f"its weight stays for {names}: int8 would be stored beside it"
        return (
            f"its weight is computed from {stored:,} bytes, and would be"
            f" {math.prod(shape):,} in the file"
        )


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
        for name, elements in (("K", size.depth), ("N", size.columns)):
            if elements is not None and elements < self.minimum:
                return f"{name} = {elements}, below {self.minimum}: less than one tile"
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
        # Channels on either side, those of an input within its group
        group = node.attributes.get_int("group", 1)
        inputs, outputs = shape[1], shape[0]
        if node.op_type == "ConvTranspose":
            inputs, outputs = shape[0] // group, shape[1] * group
        if min(inputs, outputs) >= self.minimum:
            return None
        kernel = shape[2:]
        # Kernels of grouped and of plain convolutions
        if group > 1:
            fits = outputs % self.packing == 0 and min(kernel, default=1) >= 3
        else:
            first = node.inputs[0] is not None and node.inputs[0].is_graph_input()
            packed = 0 in (inputs % self.packing, outputs % self.packing)
            wide = first or max(inputs, outputs) >= self.minimum
            fits = packed and wide and len(set(kernel)) == 1
        size = f"{inputs} to {outputs} channels in {group} groups, kernel {[*kernel]}"
        return None if fits else f"{size}: too narrow for int8 kernels"


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
        """Object to what :func:`~me2e_compress.quantization.rules` found."""
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
        operator, _, module, weight, length, _ = super().own_rules()
        safety = (Geometry(), Coordinates(), EgoInput())
        stages = (length, AttentionWeights(), MatrixVector(share=0.1))
        kernels = (SmallProduct(), NarrowConvolution(), FileSize(), CostGate())
        return (operator, module, weight, *safety, *stages, *kernels)
