"""The verdict on one pipeline and one graph: does exact mean exact?

The judge shares nothing with the manager's own numeric proof: the graph before and the
graph after are run by onnxruntime with its optimizations off, on drawn inputs.

A graph that is quantized for the target tensorrt must be itself without its int8. For
the target onnxruntime (and ``lower-int8``) weights are permuted, biases are integers
and layers are rewritten, so there only names, shapes, types and finite numbers are
checked; how close the numbers are is a matter of fidelity, not of this test.
"""

import contextlib
import dataclasses
import functools
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import onnx
import onnx.printer
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import Me2eError, PassError, VerificationError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import recipe
from me2e_compress.manager.pass_manager import PassManager
from me2e_compress.manager.report import Report
from me2e_compress.manager.reproducer import shrink
from me2e_compress.passes import Context, Pass
from tests.fuzz.exact import pipelines as texts
from tests.fuzz.exact.drawing import drawing
from tests.fuzz.exact.int8 import HALF, WHOLE, StrippingError, constants, stripped
from tests.fuzz.exact.running import (
    Answers,
    RefusedError,
    Runner,
    drawn_inputs,
    open_sizes,
)
from tests.support.frames import record

Kind = Literal[
    "right", "unchanged", "refused", "wrong", "crash", "does-not-load",
    "changes-again", "unstable", "invalid-draw",
]  # fmt: skip

BAD: tuple[Kind, ...] = ("wrong", "crash", "does-not-load", "changes-again")
"""What a pass must never be found to do."""

INT8_EVERY, SLOW_EVERY = 10, 200
"""One graph of so many is quantized too, or given to passes that start a process."""

FRAMES = 2
"""Frames that ranges are calibrated on."""

MODULES = ModuleMap.parse(
    "\n".join(
        f'[modules.{name}]\nrole = "{role}"\noptional = {globs}'
        for name, role, globs in (
            ("backbone", "feature", ["img_backbone"]),
            ("neck", "feature", ["img_neck"]),
            ("bev_encoder", "feature", ["pts_bbox_head.transformer.encoder"]),
            ("map", "prediction", ["pts_bbox_head.map_decoder"]),
            ("motion", "prediction", ["motion_head"]),
            ("planner", "prediction", ["planning_head", "**"]),
        )
    ),
    "drawn",
)


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What came of one pipeline on one graph.

    Attributes:
        kind: see :data:`Kind`.
        pipeline: that was run.
        detail: what is off, or why it was refused.
        changes: how many places each pass changed, by its name.
    """

    kind: Kind
    pipeline: str
    detail: str = ""
    changes: tuple[tuple[str, int], ...] = ()

    @property
    def is_bad(self) -> bool:
        return self.kind in BAD


Say = Callable[..., Verdict]
"""A verdict on a pipeline: its kind and detail are to be named."""


class Case:
    """A graph with its answers, ready to be judged by many pipelines.

    Raises:
        RefusedError: the graph itself does not run.
    """

    def __init__(self, model: onnx.ModelProto, seed: int = 0) -> None:
        self.model, self.seed = model, seed
        map_ = MODULES if texts.has_modules(model) else ModuleMap.whole()
        self.context = Context(map_, seed=seed)
        runner = Runner(model)
        self.sizes = open_sizes(seed, model)
        feeds = [drawn_inputs(runner, seed, size) for size in self.sizes]
        self.answers = Answers(runner, feeds)

    @functools.cached_property
    def loaded(self) -> ir.Model:
        """The graph as the toolkit reads it from a file."""
        with tempfile.TemporaryDirectory(prefix="exact-") as folder:
            path = Path(folder, "drawn.onnx")
            path.write_bytes(self.model.SerializeToString())
            return graph.load(path)

    @functools.cached_property
    def imported(self) -> ir.Model:
        """The same after ``import-normalize``, which every other pass needs."""
        passes = recipe.parse("import-normalize")
        return _run(passes, self.loaded, self.context).model

    def judge(self, pipeline: str) -> Verdict:
        """Run a pipeline and compare what it gives with the graph as drawn."""
        if pipeline.startswith("quantize-int8"):
            say = functools.partial(Verdict, pipeline=pipeline)
            return _outcome(say, lambda: self._int8(pipeline))
        text = pipeline.removeprefix(texts.PREFIX)
        dear = texts.dear_work() if text != pipeline else contextlib.nullcontext()
        with dear:
            return self.judge_passes(recipe.parse(text), pipeline)

    def judge_passes(self, passes: Sequence[Pass], pipeline: str) -> Verdict:
        """Do the same with passes that need no name that a recipe knows."""
        first = passes[0].name == "import-normalize"
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return _outcome(
                functools.partial(Verdict, pipeline=pipeline),
                lambda: self._exact(
                    pipeline, passes, self.loaded if first else self.imported
                ),
            )

    def _exact(self, pipeline: str, passes: Sequence[Pass], model: ir.Model) -> Verdict:
        report = _run(passes, model, self.context)
        changes = tuple((step.name, step.changes) for step in report.steps)
        say = functools.partial(Verdict, pipeline=pipeline, changes=changes)
        if not any(count for _, count in changes):
            return say("unchanged")
        runner = _opened(report.model)
        if lost := self._interface(runner):
            return say("wrong", detail=lost)
        fixed = any(each.changes_interface for each in passes)
        verdict = self._compared(say, runner, 1 if fixed else len(self.sizes))
        if verdict.kind != "right" or len(passes) > 1:
            return verdict
        # the same pass on what it left: there must be nothing more to do
        try:
            again = _run(passes, report.model, self.context)
        except Me2eError as error:
            return say("crash", detail=f"on its own result: {error}")
        if count := sum(step.changes for step in again.steps):
            notes = "; ".join(note for step in again.steps for note in step.notes)
            return say("changes-again", detail=f"{count} changes: {notes}")
        return verdict

    def _interface(self, runner: Runner) -> str:
        """Say what became of the inputs and outputs; empty if nothing."""
        for what in ("inputs", "outputs"):
            old, new = (
                [(name, port.type) for name, port in getattr(each, what).items()]
                for each in (self.answers.runner, runner)
            )
            if old != new:
                return f"{what} {old} became {new}"
        return ""

    def _compared(self, say: Say, runner: Runner, count: int) -> Verdict:
        shaky = ""
        for at in range(count):
            gaps = self.answers.off(at, runner.run(self.answers.feeds[at]))
            if not gaps:
                continue
            worst = max(gaps, key=lambda name: gaps[name])
            shaky = f"{worst} is off by {gaps[worst]:.3g} at batch {self.sizes[at]}"
            if self.answers.is_steady(at, gaps):
                return say("wrong", detail=shaky)
        return say("unstable" if shaky else "right", detail=shaky)

    def _int8(self, pipeline: str) -> Verdict:
        """Fold constants, quantize, and hold the result to what the module says."""
        say = functools.partial(Verdict, pipeline=pipeline)
        runner, size = self.answers.runner, self.sizes[0]
        feeds = [drawn_inputs(runner, self.seed + at, size) for at in range(FRAMES)]
        with tempfile.TemporaryDirectory(prefix="int8-") as folder:
            frames = CalibrationSet(record(Path(folder, "frames"), feeds))
            context = dataclasses.replace(self.context, frames=frames, measured={})
            base = _run(recipe.parse("fold-constants"), self.imported, context).model
            after = _run(recipe.parse(pipeline), base, context).model
        written = ir.to_proto(after)
        if not any(node.op_type == "DequantizeLinear" for node in written.graph.node):
            return say("unchanged")
        runner = _opened(after)
        if lost := self._interface(runner):
            return say("wrong", detail=lost)
        found = runner.run(self.answers.feeds[0])
        for name, value in self.answers.values[0].items():
            whole = value.dtype.kind != "f" or np.isfinite(value).all()
            if value.shape != found[name].shape:
                return say("wrong", detail=f"{name} became {found[name].shape}")
            if whole and not np.isfinite(found[name]).all():
                return say("wrong", detail=f"{name} is no longer finite")
        if "target=tensorrt" not in pipeline or "lower-int8" in pipeline:
            return say("right")
        try:
            most = HALF if "rules=paper" in pipeline else WHOLE
            plain = stripped(written, constants(ir.to_proto(base)), most)
        except StrippingError as error:
            return say("wrong", detail=str(error))
        return self._compared(say, Runner(plain), 1)


def _run(passes: Sequence[Pass], model: ir.Model, context: Context) -> Report:
    return PassManager(tuple(passes), verify_frames=0).run(model, context)


def _opened(model: ir.Model) -> Runner:
    written = ir.to_proto(model)
    onnx.checker.check_model(written)
    return Runner(written)


def _outcome(say: Say, judge: Callable[[], Verdict]) -> Verdict:
    """Return a verdict, or what was raised in its stead as one."""
    try:
        return judge()
    except VerificationError as error:
        broken = "invalid graph" in str(error) or " left " in str(error)
        return say("does-not-load" if broken else "crash", detail=str(error))
    except (RefusedError, onnx.checker.ValidationError) as error:
        return say("does-not-load", detail=str(error))
    except Me2eError as error:
        kind = "crash" if isinstance(error, PassError) else "refused"
        return say(kind, detail=str(error))
    except Exception as error:  # the judge must outlive whatever is raised
        return say("crash", detail=f"{type(error).__name__}: {error}")


def judged(
    seed: int, model: onnx.ModelProto, pipelines: Sequence[str]
) -> Iterator[Verdict]:
    """Judge a graph by some pipelines."""
    try:
        case = Case(model, seed)
    except RefusedError as error:
        yield Verdict("invalid-draw", "", str(error))
        return
    yield from map(case.judge, pipelines)


def findings(seed: int) -> list[str]:
    """Judge one graph of a night; tell what no pass may do to it."""
    model = drawing(seed).model
    pipelines = texts.some_for(model, seed, texts.LONG)
    if seed % SLOW_EVERY == 0:
        pipelines += texts.SLOW
    if seed % INT8_EVERY == 0:
        pipelines += tuple(texts.int8_ways(model, seed))
    return [report(seed, e) for e in judged(seed, model, pipelines) if e.is_bad]


def shrunk(model: onnx.ModelProto, kind_of: Callable[[onnx.ModelProto], Kind]) -> str:
    """Write, in ONNX's syntax, a part of a graph of which the verdict is the same."""
    kind, whole = kind_of(model), ir.from_proto(model)
    graph.infer_shapes(whole)
    small = shrink(whole, lambda part: kind_of(ir.to_proto(part)) == kind)
    return onnx.printer.to_text(ir.to_proto(small))


def report(seed: int, found: Verdict) -> str:
    """Tell a finding, with a part of the graph that shows it."""
    whole = drawing(seed)

    def kind_of(part: onnx.ModelProto) -> Kind:
        (verdict,) = judged(seed, part, [found.pipeline])
        return verdict.kind

    return (
        f"seed {seed} ({', '.join(whole.motifs)}), pipeline {found.pipeline}\n"
        f"{found.kind}: {found.detail}\n{shrunk(whole.model, kind_of)}"
    )
