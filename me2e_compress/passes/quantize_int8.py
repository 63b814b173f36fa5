"""Quantize to int8 where a plan says so."""

import abc
import dataclasses
import functools
from pathlib import Path
from typing import ClassVar

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import plural
from me2e_compress.base.errors import FramesError, PreconditionError
from me2e_compress.base.registry import IN_TEXT
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.ranges import Ranges, review
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.quantization.decision import (
    METADATA,
    Overrides,
    QuantPlan,
    QuantScheme,
    stamp_plan,
)
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import DEFAULT_RULES, RULE_SETS, RuleSet
from me2e_compress.targets import DEFAULT_TARGET, TARGETS, Target
from me2e_compress.targets.onnxruntime.convert import unranged
from me2e_compress.targets.quantized import describe_quantized


@dataclasses.dataclass(frozen=True)
class Quantizer(Pass):
    """A pass that calibrates tensors; it has the options ``ranges`` and ``method``.

    ``ranges`` is a file that replaces frames. The class attribute ``takes_float`` is
    True of a pass that quantizes a float graph to int8.
    """

    takes_float: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def method_of_ranges(self) -> str:
        """The calibration method by which ranges are read from frames."""

    @abc.abstractmethod
    def ranged_tensors(self, model: ir.Model, context: Context) -> tuple[str, ...]:
        """Return the names of the tensors it calibrates; shapes must be inferred."""

    def read_ranges(
        self,
        model: ir.Model,
        tensors: tuple[str, ...],
        context: Context,
        saved: Path | None,
    ) -> Ranges:
        """Load the ranges of tensors from ``saved``, or measure them on the frames.

        Raises:
            FramesError: neither frames nor a file, or they are of another graph.
        """
        # Saved ranges must belong to this graph and these frames
        digest, method = graph.digest(model), self.method_of_ranges
        if saved is not None:
            ranges, frames = Ranges.load(saved), context.frames
            source = None if frames is None else frames.fingerprint
            ranges.check(
                model=digest, tensors=tensors, method=method, source=source, named=saved
            )
            return ranges
        if context.frames is None:
            raise FramesError(
                f"{self.name} needs recorded frames (--frames) or saved ranges"
                " (--ranges): int8 ranges are never made up"
            )
        # Measure only what an earlier run has not measured
        known = context.measured.get(self.name)
        if known is None or not known.hold_for(digest, tensors, method):
            calibrator = Calibrator(method, provider=context.provider)
            known = calibrator.run(model, tensors, context.frames)
            context.measured[self.name] = known
        return known


def quantizes_float(current: Pass) -> bool:
    """Return whether a pass quantizes a float graph to int8."""
    return isinstance(current, Quantizer) and current.takes_float


@dataclasses.dataclass(frozen=True)
class QuantizeInt8(Quantizer):
    """Quantize the layers and short attentions of some modules to int8.

    Given:   y = Conv(x, w, b)
    Result:  y = Conv(DequantizeLinear(QuantizeLinear(x)), DequantizeLinear(w_int8), b)

    The plan (:mod:`me2e_compress.quantization.plan`) decides which nodes, gives the
    reason for the others, and is stored in the graph's metadata: geometry, positions,
    attention weights and matrix-vector products stay float. Ranges are measured on the
    context's frames, or read from a file; there is no calibration on made-up data.

    Attributes:
        scheme: ``feature-ext``, ``prediction`` or ``full``, or a list of modules.
        rules: ``safe``; ``paper``, its two stages alone; a rule set of your own, by
            name or, in Python, as an object; with options, ``paper{without=[gemv]}``.
        target: who will run the graph: ``onnxruntime``, ``tensorrt``.
        overrides: TOML file of exceptions to the plan.
        method: how ranges are read from the frames: ``max-min``, ``percentile:P`` or
            ``mse``; None leaves it to the rules (``safe``: ``mse``, ``paper``:
            ``max-min``).
        ranges: file of saved ranges instead of frames.
    """

    name = "quantize-int8"
    exact = False
    takes_float = True
    scheme: str | tuple[str, ...] = "full"
    rules: str | RuleSet = DEFAULT_RULES
    # what a text means must not change with the default
    target: str = dataclasses.field(default=DEFAULT_TARGET, metadata=IN_TEXT)
    overrides: Path | None = None
    method: str | None = None
    ranges: Path | None = None

    @property
    def needs_frames(self) -> bool:
        """Whether frames are needed because no saved ranges are given."""
        return self.ranges is None

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Plan, calibrate, and place quantizers.

        Raises:
            PreconditionError: a plan quantized the graph, or its layers are operators
                on integers; or it has an opset or type without int8.
            FramesError: neither frames nor ranges, or they are of another graph.
        """
        if METADATA in model.metadata_props:
            refuse_quantized(model)
        # Plan, and stop if there is nothing to do
        target, plan = self._runtime, self.plan(model, context)
        target.check_types(plan, model)
        tensors = target.tensors(plan, model)
        if not tensors:
            if not plan.counts():  # there is no layer but in integers
                refuse_quantized(model)
            return PassResult(model, 0, ("nothing to quantize", plan.headline))
        # Calibrate
        ranges = self.read_ranges(model, tensors, context, self.ranges)
        # Place the quantizers and record the plan
        placed = target.place(model, plan, ranges)
        stamp_plan(placed, plan)
        count, frames = len(ranges.tensors), plural(ranges.frames, "frame")
        on = f"{plural(count, 'tensor')} calibrated on {frames}"
        notes = (plan.headline, on, *map(str, review(ranges)))
        return PassResult(placed, len(plan.placed), notes)

    def plan(self, model: ir.Model, context: Context) -> QuantPlan:
        """Choose for every node, as its target can; shapes must be inferred."""
        file, target, modules = self.overrides, self._runtime, context.modules
        overrides = Overrides() if file is None else Overrides.load(file)
        scheme = QuantScheme.of(self.scheme, modules)
        costs, objection = target.costs, target.fused_objection
        plan = make_plan(model, scheme, self._rules(), overrides, costs, objection)
        kept_float = target.kept_float(plan, model)
        return dataclasses.replace(plan, kept_float=kept_float, target=target.name)

    def ranged_tensors(self, model: ir.Model, context: Context) -> tuple[str, ...]:
        """Return the names of the tensors that its target reads in int8."""
        return self._runtime.tensors(self.plan(model, context), model)

    @property
    def method_of_ranges(self) -> str:
        """The method that was asked for, else the one of the rules."""
        return self.method or self._rules().method

    @functools.cached_property
    def _runtime(self) -> Target:
        return TARGETS.parse(self.target)

    def _rules(self) -> RuleSet:
        named = self.rules
        return RULE_SETS.parse(named) if isinstance(named, str) else named


def refuse_quantized(model: ir.Model) -> None:
    """Raise a PreconditionError of a graph that is quantized already."""
    if already := describe_quantized(model):
        rewrite = ", or let lower-int8 rewrite this one for onnxruntime"
        try:  # only symmetric pairs of int8 have ranges that it could write down
            unranged(model)
        except PreconditionError:
            rewrite = ""
        raise PreconditionError(
            f"the graph is quantized already: {already}; int8 is not put on int8,"
            f" give the float graph that it was made of{rewrite}"
        )
