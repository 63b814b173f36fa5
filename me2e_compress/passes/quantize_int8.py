"""Int8 where a plan says so."""

import dataclasses
from pathlib import Path
from typing import ClassVar

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.plan import INT8, QuantPlan, make_plan, tensors_of
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.rules import paper_rules
from me2e_compress.calibration.scheme import QuantScheme
from me2e_compress.errors import FramesError, PreconditionError
from me2e_compress.passes.base import Context, PassResult
from me2e_compress.targets.tensorrt import place

QUANTIZED_OPS = frozenset(
    {
        "ConvInteger", "DequantizeLinear", "DynamicQuantizeLinear", "MatMulInteger",
        "QLinearConv", "QLinearMatMul", "QuantizeLinear",
    }
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class QuantizeInt8:
    """Let layers and short attentions of some modules read int8.

    Given:   y = Conv(x, w, b)
    Result:  y = Conv(DequantizeLinear(QuantizeLinear(x)), DequantizeLinear(w_int8), b)

    Which nodes, and why the others not, is the plan's to say
    (:mod:`me2e_compress.calibration.plan`): attention of more than ``attention_limit``
    tokens and matrix-vector products stay float. Ranges are measured on the context's
    frames, or read from a file; there is no calibration on made-up data.

    Attributes:
        scheme: ``feature-ext``, ``prediction`` or ``full``.
        modules: module names instead of a scheme.
        attention_limit: longest attention that becomes int8, in tokens.
        method: how ranges are read from the frames: ``max-min``.
        ranges: file of saved ranges instead of frames.
    """

    name: ClassVar[str] = "quantize-int8"
    exact: ClassVar[bool] = False
    changes_interface: ClassVar[bool] = False
    scheme: str = "full"
    modules: tuple[str, ...] = ()
    attention_limit: int = 512
    method: str = "max-min"
    ranges: str | None = None

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Plan, calibrate, place.

        Raises:
            PreconditionError: the graph is quantized already, or of opset below 13.
            FramesError: neither frames nor ranges, or they are of another graph.
            ModuleMapError: no such module.
            RecipeError: no such scheme or method.
        """
        _refuse_quantized(model)
        graph.infer_shapes(model)
        rules = paper_rules(self.attention_limit)
        plan = make_plan(model, self._scheme(context), rules)
        tensors = tensors_of(plan, model)
        if not tensors:
            return PassResult(model, 0, ("nothing to quantize", *_notes(plan)))
        ranges = self._ranges(model, tensors, context)
        placed = place(model, plan, ranges)
        notes = (*_notes(plan), *_findings(ranges))
        return PassResult(placed, len(plan.chosen), notes)

    def _scheme(self, context: Context) -> QuantScheme:
        if self.modules:
            return QuantScheme.of(self.modules, context.modules)
        return QuantScheme.named(self.scheme, context.modules)

    def _ranges(
        self, model: ir.Model, tensors: tuple[str, ...], context: Context
    ) -> Ranges:
        frames = context.frames
        if self.ranges is not None:
            saved = Ranges.load(Path(self.ranges))
            saved.check(
                model=graph.digest(model),
                tensors=tensors,
                method=self.method,
                source=None if frames is None else frames.fingerprint,
            )
            return saved
        if frames is None:
            raise FramesError(
                f"{self.name} needs recorded frames (--frames) or saved ranges"
                " (--ranges): int8 ranges are never made up"
            )
        return Calibrator(self.method).run(model, tensors, frames)


def _refuse_quantized(model: ir.Model) -> None:
    for node in model.graph.all_nodes():
        if node.op_type in QUANTIZED_OPS:
            raise PreconditionError(
                f"the graph is quantized already: {node.op_type} {node.name!r};"
                " give the float graph, int8 is not put on int8"
            )


def _notes(plan: QuantPlan) -> tuple[str, ...]:
    counts = ", ".join(f"{rule} {count}" for rule, count in plan.counts().items())
    scheme = plan.scheme
    return (
        f"scheme {scheme.name}: {', '.join(scheme.modules)}",
        f"{len(plan.chosen)} of {len(plan.decisions)} nodes {INT8}; by rule: {counts}",
    )


def _findings(ranges: Ranges) -> tuple[str, ...]:
    notes = [f"{len(ranges.tensors)} tensors calibrated on {ranges.frames} frames"]
    if ranges.dead:
        notes.append(
            f"{len(ranges.dead)} tensors are always zero: {', '.join(ranges.dead[:5])}"
        )
    return tuple(notes)
