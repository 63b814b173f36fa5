"""Apply a plan to a graph in the form of onnxruntime's CPU kernels."""

import dataclasses
from collections.abc import Collection
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.operators import int8_inputs, int8_op_types
from me2e_compress.quantization.costs import Costs
from me2e_compress.quantization.plan import Decision, KeptFloat, QuantPlan
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets.base import LintFinding, LintRule, Target
from me2e_compress.targets.onnxruntime.costs import costs_of
from me2e_compress.targets.onnxruntime.kernels import objection
from me2e_compress.targets.onnxruntime.lint_rules import RULES
from me2e_compress.targets.onnxruntime.lower import Draft, lower
from me2e_compress.targets.onnxruntime.read_back import read_back
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
        weights = weights_of(model, _layers_of(plan))
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
        return tuple(read_back(model, provider))


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
