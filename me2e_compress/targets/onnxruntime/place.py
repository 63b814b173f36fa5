"""Apply a plan to a graph in the form of onnxruntime's CPU kernels."""

import dataclasses
from collections.abc import Collection, Iterator
from typing import ClassVar

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.errors import GraphError
from me2e_compress.operators import int8_inputs, int8_op_types
from me2e_compress.quantization.costs import Costs
from me2e_compress.quantization.plan import Decision, KeptFloat, QuantPlan
from me2e_compress.runtime.optimized import optimized, origins, with_unique_names
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets.base import (
    LintFinding,
    LintRule,
    Target,
    error,
    warning,
)
from me2e_compress.targets.onnxruntime.convert import int8_layers
from me2e_compress.targets.onnxruntime.costs import costs_of
from me2e_compress.targets.onnxruntime.kernels import objection
from me2e_compress.targets.onnxruntime.lint_rules import RULES
from me2e_compress.targets.onnxruntime.lower import Draft, lower
from me2e_compress.targets.onnxruntime.region import Region, find_region
from me2e_compress.targets.weights import weights_of


@dataclasses.dataclass(frozen=True)
class OnnxRuntime(Target):
    """onnxruntime's CPU kernels: uint8 activations, quantized outputs, 2-D products."""

    name: ClassVar[str] = "onnxruntime"
    opens: ClassVar[bool] = True

    def tensors(self, plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
        """Return the activations whose range is needed: inputs, outputs of layers."""
        return _region(plan, model).ranged

    def place(self, model: ir.Model, plan: QuantPlan, ranges: Ranges) -> ir.Model:
        """Return a copy of a graph in which the plan's layers run in int8 on the CPU.

        Products of two activations stay float here. ``ranges`` must have every tensor
        that :meth:`tensors` lists.
        """
        self.check_types(plan, model)
        weights = weights_of(model, _layers_of(plan), balanced=plan.balanced)
        reach = {name: max(-low, high) for name, (low, high) in ranges.tensors.items()}
        sampled = [each.output for each in _sampling(plan)]
        return lower(Draft(model.clone(), weights, reach, sampled))

    def kept_float(self, plan: QuantPlan, model: ir.Model) -> tuple[KeptFloat, ...]:
        """List the plan's nodes that :meth:`place` leaves in float, and why."""
        region = _region(plan, model)
        nodes = {str(node.outputs[0].name): node for node in model.graph}
        # Nodes without an objection become int8.
        reasons = (
            (each, _objection(nodes[each.output], each, region)) for each in plan.chosen
        )
        return tuple(
            KeptFloat(each.node, each.output, reason)
            for each, reason in reasons
            if reason
        )

    def fused_objection(self, node: ir.Node) -> str | None:
        """Return None: compiled kernels read uint8 directly."""
        return None

    def costs(self, model: ir.Model, layers: Collection[ir.Node]) -> Costs:
        """Estimate the savings and costs of int8 for some layers on one core."""
        return costs_of(model, layers)

    def lint_rules(self) -> tuple[LintRule, ...]:
        """Return the rules for its kernels."""
        return RULES

    def read_back(
        self, model: ir.Model, provider: Provider = CPU
    ) -> tuple[LintFinding, ...]:
        """Open a graph, and list its int8 layers that run in float."""
        return tuple(_read_back(model, provider))


def _layers_of(plan: QuantPlan) -> tuple[Decision, ...]:
    """Return the int8 layers of a plan without products of two activations.

    Int8 makes those slower on this target: 0.55 to 0.9 times the speed of float.
    """
    return tuple(each for each in plan.chosen if each.weight is not None)


def _sampling(plan: QuantPlan) -> tuple[Decision, ...]:
    """Return the fused operators of a plan that sample int8."""
    names = int8_op_types()
    return tuple(each for each in plan.chosen if each.op in names)


def _region(plan: QuantPlan, model: ir.Model) -> Region:
    chosen = {each.output for each in (*_layers_of(plan), *_sampling(plan))}
    return find_region(model.graph, chosen)


def _objection(node: ir.Node, decision: Decision, region: Region) -> str | None:
    if node in region.layers or node in region.readers or int8_inputs(node):
        return None
    if decision.weight is not None:
        return objection(node)
    if node.op_type == "Add":
        return "a sum that no int8 kernel reads, or of which none gives a side"
    return "products of two activations are slower in int8"


_FLOAT_KERNELS = frozenset(
    {
        "Conv", "ConvTranspose", "FusedConv", "FusedGemm", "FusedMatMul", "Gemm",
        "MatMul", "NhwcFusedConv",
    }
)  # fmt: skip
"""Layers in the optimized graph that compute in float."""


def _read_back(model: ir.Model, provider: Provider = CPU) -> Iterator[LintFinding]:
    """Find layers that are int8 in a graph, but float in the session that runs it.

    onnxruntime looks for int8 after its first fusions, and for complete patterns: a
    bias, a ReLU or a second reader of a layer's output hides the layer.
    """
    source = with_unique_names(model)
    try:
        found = optimized(source, provider)
    except GraphError as refusal:
        yield error("refused", None, str(refusal))
        return
    known = origins(source, found)
    for node in int8_layers(found, _FLOAT_KERNELS):
        layer = _layer_of(known.get(str(node.name), node))
        yield warning("float-kernel", layer, _what(layer, node.op_type))


def _layer_of(node: ir.Node) -> ir.Node:
    """Return the layer of a fused node: itself, or the input of its ReLU or bias."""
    maker = graph.producer_of(node.inputs[0])
    if node.op_type in _FLOAT_KERNELS or maker is None:
        return node
    return maker if maker.op_type in _FLOAT_KERNELS else node


def _what(layer: ir.Node, kernel: str) -> str:
    """Describe the kernel and the readers of its output, which are often the reason."""
    readers = dict.fromkeys(each.op_type for each in layer.outputs[0].consumers())
    read = f"; {' and '.join(readers)} reads it" if readers else ""
    return f"reads int8, and runs in float, as {kernel}{read}"
