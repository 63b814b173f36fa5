"""Gradients of standard operators, written as nodes behind a graph.

For each operator one rule: from the gradient of what a node gives, those of what it
reads (its vector-Jacobian product). Sizes must be known. Comparisons, whole numbers and
the choice of a TopK have no gradient; an operator without a rule is told.
"""

import dataclasses
from collections.abc import Mapping

import onnx_ir as ir

from me2e_compress.graph import is_standard
from me2e_compress.graph.nodes import FLOATS
from me2e_compress.sensitivity.gradients import (
    elementwise,
    layout,
    products,
    sampling,
)
from me2e_compress.sensitivity.gradients.tape import (
    Found,
    NoRuleError,
    Rule,
    Tape,
    sizes_of,
)

__all__ = ["RULES", "Backward", "Tape"]

RULES: Mapping[str, Rule] = {
    **elementwise.RULES,
    **products.RULES,
    **layout.RULES,
    **sampling.RULES,
}
"""Rules by operator; Split, which gives several tensors, has one of its own."""


@dataclasses.dataclass
class Backward:
    """The gradients of a graph's values, written from the last node to the first.

    Attributes:
        tape: where they are written.
        wanted: values through which gradients must pass.
        most_held: bytes of the graph's own tensors that may be kept in memory.
        found: gradients, by value.
        missing: inputs that a gradient should reach but does not, with the reasons.
    """

    tape: Tape
    wanted: set[ir.Value]
    most_held: int
    found: dict[ir.Value, ir.Value] = dataclasses.field(default_factory=dict)
    missing: dict[ir.Value, str] = dataclasses.field(default_factory=dict)

    def seed(self, value: ir.Value, gradient: ir.Value) -> None:
        """Add a gradient to that of a value."""
        known = self.found.get(value)
        if known is not None:
            gradient = self.tape.op("Add", [known, gradient])
        self.found[value] = gradient

    def pass_through(self, node: ir.Node) -> None:
        """Add what a node hands to its inputs."""
        reads = [v for v in node.inputs if v in self.wanted and _is_float(v)]
        if not reads or not any(value in self.found for value in node.outputs):
            return
        try:
            if self.tape.held > self.most_held:
                raise NoRuleError(f"{self.most_held / 1e9:.1f} GB are held already")
            gradients = self._of(node)
        except NoRuleError as reason:
            name = node.name or node.outputs[0].name
            self.missing |= dict.fromkeys(
                filter(None, reads), f"{node.op_type} {name}: {reason}"
            )
            return
        for value, gradient in zip(node.inputs, gradients, strict=False):
            if value is not None and value in reads and gradient is not None:
                self.seed(value, gradient)

    def _of(self, node: ir.Node) -> Found:
        if not is_standard(node):
            raise NoRuleError("no rule")
        if node.op_type == "Split":
            return _split(self.tape, node, self.found)
        if node.op_type not in RULES:
            raise NoRuleError("no rule")
        if node.outputs[0] not in self.found:  # a mean, a mask, an index
            raise NoRuleError("no rule for a second output")
        return RULES[node.op_type](self.tape, node, self.found[node.outputs[0]])


def _split(t: Tape, node: ir.Node, found: Mapping[ir.Value, ir.Value]) -> Found:
    parts = [
        found[value] if value in found else t.zeros(sizes_of(value), value)
        for value in node.outputs
    ]
    return [t.op("Concat", parts, {"axis": node.attributes.get_int("axis", 0)})]


def _is_float(value: ir.Value | None) -> bool:
    return value is not None and (value.dtype is None or value.dtype in FLOATS)
