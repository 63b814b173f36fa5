"""onnxruntime on the CPU: int8 in the form for which it has kernels."""

import dataclasses
from collections.abc import Collection
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.base.errors import GraphError
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph.nodes import maker
from me2e_compress.operators import int8_inputs, int8_op_types
from me2e_compress.quantization.costs import Costs
from me2e_compress.quantization.decision import Decision, KeptFloat, QuantPlan
from me2e_compress.runtime.optimized import optimize, origins, with_unique_names
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets import LintFinding, LintRule, Target, error, warning
from me2e_compress.targets.onnxruntime.convert import int8_layers
from me2e_compress.targets.onnxruntime.costs import costs_of
from me2e_compress.targets.onnxruntime.lint_rules import RULES
from me2e_compress.targets.onnxruntime.lower import Draft, lower, symmetric
from me2e_compress.targets.onnxruntime.region import find_region, objection
from me2e_compress.targets.weights import weights_of


@dataclasses.dataclass(frozen=True)
class OnnxRuntime(Target):
    """onnxruntime's CPU kernels: uint8 activations, quantized outputs, 2-D products."""

    name: ClassVar[str] = "onnxruntime"
    runs_in: ClassVar[str] = "cpu"

    def tensors(self, plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
        """List the activations whose range is needed: inputs, outputs of layers."""
        layers, sampling = _int8_of(plan)
        return find_region(model.graph, {*layers, *sampling}).ranged

    def place(self, model: ir.Model, plan: QuantPlan, ranges: Ranges) -> ir.Model:
        """Return a copy of a graph in which the plan's layers run in int8 on the CPU.

        Products of two activations stay float here. ``ranges`` must have every tensor
        that :meth:`tensors` lists.
        """
        self.check_types(plan, model)
        layers, sampling = _int8_of(plan)
        weights = weights_of(model, layers.values(), balanced=plan.balanced)
        bounds = ranges.tensors if plan.balanced else symmetric(ranges.tensors)
        return lower(Draft(model.clone(), weights, bounds, list(sampling)))

    def kept_float(self, plan: QuantPlan, model: ir.Model) -> tuple[KeptFloat, ...]:
        """List the plan's nodes that :meth:`place` leaves in float, and why."""
        layers, sampling = _int8_of(plan)
        region = find_region(model.graph, {*layers, *sampling})
        nodes = {str(node.outputs[0].name): node for node in model.graph}
        floats = list[KeptFloat]()
        for decision in plan.chosen:
            node = nodes[decision.output]
            if node in region.layers or node in region.readers or int8_inputs(node):
                continue
            reason: str | None = "products of two activations are slower in int8"
            if decision.weight is not None:
                reason = objection(node)
            elif node.op_type == "Add":
                reason = (
                    "a sum that no int8 kernel reads, or of which none gives a side"
                )
            if reason:
                floats.append(KeptFloat(decision.node, decision.output, reason))
        return tuple(floats)

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
        """Open a graph, and list the layers that are int8 in it and run in float."""
        # onnxruntime looks for int8 after its first fusions, and for complete patterns:
        # a bias, a ReLU or a second reader of a layer's output hides the layer
        source = with_unique_names(model)
        try:
            running = optimize(source, provider)
        except GraphError as refusal:
            return (error("refused", None, str(refusal)),)
        known = origins(source, running)
        findings = list[LintFinding]()
        for node in int8_layers(running, _FLOAT_KERNELS):
            # The layer of a fused node: itself, or the input of its ReLU or bias
            layer = known.get(str(node.name), node)
            producer = maker(layer.inputs[0], *_FLOAT_KERNELS)
            if producer is not None and layer.op_type not in _FLOAT_KERNELS:
                layer = producer
            # The readers of its output are often the reason
            readers = dict.fromkeys(n.op_type for n in layer.outputs[0].consumers())
            read = f"; {' and '.join(readers)} reads it" if readers else ""
            message = f"reads int8, and runs in float, as {node.op_type}{read}"
            findings.append(warning("float-kernel", layer, message))
        return tuple(findings)


# Layers in the optimized graph that compute in float
_FLOAT_KERNELS = frozenset(
    {
        "Conv", "ConvTranspose", "FusedConv", "FusedGemm", "FusedMatMul", "Gemm",
        "MatMul", "NhwcFusedConv",
    }
)  # fmt: skip


def _int8_of(plan: QuantPlan) -> tuple[dict[str, Decision], dict[str, Decision]]:
    """Return a plan's int8 layers, and the operators that sample int8, by output."""
    # Products of two activations are left out: int8 makes them slower on this target,
    # 0.55 to 0.9 times the speed of float
    names = int8_op_types()
    layers = {d.output: d for d in plan.chosen if d.weight is not None}
    return layers, {d.output: d for d in plan.chosen if d.op in names}
