"""What a compression made int8, and what stayed float and why."""

import dataclasses
from collections import Counter
from collections.abc import Mapping
from typing import Self

import onnx_ir as ir

from me2e_compress.base.display import format_mb, plural
from me2e_compress.graph import WEIGHTED
from me2e_compress.manager import Report
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8, quantizes_float
from me2e_compress.quantization.decision import FLOAT, QuantPlan, plan_of
from me2e_compress.runtime.providers import CPU

LEAST_BYTES = 1024
"""Smaller constants are not worth a word."""

_FLOATS = (ir.DataType.FLOAT, ir.DataType.FLOAT16, ir.DataType.DOUBLE)


def float_bytes(model: ir.Model, plan: QuantPlan) -> dict[str, int]:
    """Return the bytes of weights that stay float by rule, the most first.

    Left out are weights that any node stores as int8, biases of int8 layers, and
    constants below a kilobyte. What the plan's target leaves in float is by ``target``.
    """
    decided = {each.output: each for each in plan.decisions}
    left_float = {each.output for each in plan.kept_float}
    # float weights, and those that some other node stores as int8
    left, stored = dict[str, tuple[str, int]](), set[str]()
    for node in model.graph:
        decision = decided.get(str(node.outputs[0].name)) if node.outputs else None
        if decision is None:
            continue
        is_int8 = decision.dtype != FLOAT and decision.output not in left_float
        for at, value in enumerate(node.inputs):
            if value is None or (tensor := value.const_value) is None:
                continue
            if tensor.dtype not in _FLOATS or tensor.nbytes < LEAST_BYTES:
                continue
            if is_int8 and at == decision.weight:
                stored.add(str(value.name))
            elif not is_int8:
                rule = "target" if decision.output in left_float else decision.rule
                left.setdefault(str(value.name), (rule, tensor.nbytes))
    by_rule = Counter[str]()
    for name, (rule, size) in left.items():
        by_rule[rule] += 0 if name in stored else size
    return {rule: size for rule, size in by_rule.most_common() if size}


LEAST_SHOWN = 10_000
"""Bytes of float weights from which on a rule is named."""
_FOR_TENSORRT = (
    "it is quantized in TensorRT's form, slow in onnxruntime's CPU: --target"
    " onnxruntime writes what is fast here"
)


@dataclasses.dataclass(frozen=True)
class Int8Outcome:
    """What the pass that quantizes achieved.

    Attributes:
        by: name of the pass.
        nodes: number of nodes that it made int8.
        layers: convolutions and matrix products; in all modules, None where
            the pass leaves no plan.
        kept: layers left float, by rule and reason; most first.
        float_bytes: weights that stayed float, by rule; most first.
        slow_here: that this CPU runs it slowly, and what is fast; None where it is not
            for TensorRT, or another provider runs it.
    """

    by: str
    nodes: int
    layers: int | None = None
    kept: Mapping[str, int] = dataclasses.field(default_factory=dict)
    float_bytes: Mapping[str, int] = dataclasses.field(default_factory=dict)
    slow_here: str | None = None

    @classmethod
    def of(cls, report: Report, context: Context) -> Self | None:
        """Read the outcome from a run of the manager; None where no pass quantizes."""
        quantizer = next((e for e in report.lossy if quantizes_float(e.applied)), None)
        if quantizer is None:
            return None
        name, changes = quantizer.applied.name, quantizer.changes
        # the plan that was carried out; if nothing changed, it is made again
        plan = plan_of(report.model) if changes else None
        if plan is None and isinstance(quantizer.applied, QuantizeInt8):
            plan = quantizer.applied.plan(quantizer.before, context)
        # without a plan only the number of changes is known
        if plan is None:
            return cls(name, changes)
        layers = [each for each in plan.decisions if each.op in WEIGHTED]
        placed = {each.output for each in plan.placed}
        left = [each for each in layers if each.output not in placed]
        why = {each.output: f"target: {each.reason}" for each in plan.kept_float}
        kept = Counter(why.get(e.output, f"{e.rule}: {e.reason}") for e in left)
        slow = plan.target == "tensorrt" and context.provider.native == CPU.native
        return cls(
            name,
            changes,
            len(layers),
            dict(kept.most_common()),
            float_bytes(quantizer.before, plan),
            _FOR_TENSORRT if changes and slow else None,
        )

    @property
    def line(self) -> str:
        """How many nodes became int8, and which weights did not."""
        line = f"int8: {plural(self.nodes, 'node')}"
        if self.float_bytes:
            rules = ", ".join(
                f"{rule} {format_mb(count)}"
                for rule, count in self.float_bytes.items()
                if count >= LEAST_SHOWN
            )
            total = format_mb(sum(self.float_bytes.values()))
            line += f"; {total} MB of weights stay float"
            line += f", by rule: {rules}" if rules else ""
        return line

    @property
    def why_empty(self) -> str:
        """Why nothing became int8, with the two commonest rules; empty if some did."""
        if self.nodes:
            return ""
        # say what the layers are kept float by, the commonest rules first
        parts = [f"{self.by} made nothing int8"]
        if self.layers is not None:
            of = "(convolutions, matrix products) in the graph"
            parts.append(f"{plural(self.layers, 'layer')} {of}")
        most = list(self.kept.items())[:2]
        parts += [f"{count} by rule {why}" for why, count in most]
        return "; ".join(parts)
