"""The verdict on one pipeline and one graph: does exact mean exact?

The judge shares nothing with the manager's own numeric proof: the graph before and the
graph after are run by onnxruntime with its optimizations off, on drawn inputs.
"""

import contextlib
import dataclasses
import functools
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import onnx
import onnx.printer
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import Me2eError, PassError, VerificationError
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.manager import recipe
from me2e_compress.manager.pass_manager import PassManager
from me2e_compress.manager.report import Report
from me2e_compress.manager.reproducer import shrink
from me2e_compress.passes import Context, Pass
from tests.fuzz.exact.drawing import drawing
from tests.fuzz.exact.pipelines import PREFIX, dear_work
from tests.fuzz.exact.running import (
    Answers,
    RefusedError,
    Runner,
    drawn_inputs,
    open_sizes,
)

Kind = Literal[
    "right", "unchanged", "refused", "wrong", "crash", "does-not-load",
    "changes-again", "unstable", "invalid-draw",
]  # fmt: skip

BAD: tuple[Kind, ...] = ("wrong", "crash", "does-not-load", "changes-again")
"""What a pass must never be found to do."""


MODULES = ModuleMap.parse(
    """
    [modules.backbone]
    role = "feature"
    optional = ["img_backbone"]
    [modules.neck]
    role = "feature"
    optional = ["img_neck"]
    [modules.bev_encoder]
    role = "feature"
    optional = ["pts_bbox_head.transformer.encoder"]
    [modules.map]
    role = "prediction"
    optional = ["pts_bbox_head.map_decoder"]
    [modules.motion]
    role = "prediction"
    optional = ["motion_head"]
    [modules.planner]
    role = "prediction"
    optional = ["planning_head", "**"]
    """,
    "drawn",
)


def modules_of(model: onnx.ModelProto) -> ModuleMap:
    """Return the map that fits a graph, of one module where nodes have no paths."""
    named = any(node.name.startswith("/") for node in model.graph.node)
    return MODULES if named else ModuleMap.whole()


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


class Case:
    """A graph with its answers, ready to be judged by many pipelines.

    Raises:
        RefusedError: the graph itself does not run.
    """

    def __init__(self, model: onnx.ModelProto, seed: int = 0) -> None:
        self.model, self.seed = model, seed
        self.context = Context(modules_of(model), seed=seed)
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
        return self._run(recipe.parse("import-normalize"), self.loaded).model

    def judge(self, pipeline: str) -> Verdict:
        """Run a pipeline and compare what it gives with the graph as drawn."""
        text = pipeline.removeprefix(PREFIX)
        dear = dear_work() if text != pipeline else contextlib.nullcontext()
        with dear:
            return self.judge_passes(recipe.parse(text), pipeline)

    def judge_passes(self, passes: Sequence[Pass], pipeline: str) -> Verdict:
        """Do the same with passes that need no name that a recipe knows."""
        first = passes[0].name == "import-normalize"
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                given = self.loaded if first else self.imported
                report = self._run(passes, given)
            except VerificationError as error:
                said = str(error)
                broken = "invalid graph" in said or " left " in said
                return Verdict("does-not-load" if broken else "crash", pipeline, said)
            except PassError as error:
                return Verdict("crash", pipeline, str(error))
            except Me2eError as error:
                return Verdict("refused", pipeline, str(error))
            except Exception as error:  # the judge must outlive whatever is raised
                said = f"{type(error).__name__}: {error}"
                return Verdict("crash", pipeline, said)
            return self._verdict(pipeline, passes, report)

    def _run(self, passes: Sequence[Pass], model: ir.Model) -> Report:
        return PassManager(tuple(passes), verify_frames=0).run(model, self.context)

    def _verdict(
        self, pipeline: str, passes: Sequence[Pass], report: Report
    ) -> Verdict:
        changes = tuple((step.name, step.changes) for step in report.steps)
        say = functools.partial(Verdict, pipeline=pipeline, changes=changes)
        if not any(count for _, count in changes):
            return say("unchanged")
        after = ir.to_proto(report.model)
        try:
            onnx.checker.check_model(after)
            runner = Runner(after)
        except (RefusedError, onnx.checker.ValidationError) as error:
            return say("does-not-load", detail=str(error))
        if lost := self._interface(runner):
            return say("wrong", detail=lost)
        fixed = any(each.changes_interface for each in passes)
        try:
            kind, detail = self._compared(runner, 1 if fixed else len(self.sizes))
        except RefusedError as error:
            return say("does-not-load", detail=str(error))
        if kind == "right" and len(passes) == 1:
            return self._again(say, passes, report)
        return say(kind, detail=detail)

    def _again(
        self, say: "functools.partial[Verdict]", passes: Sequence[Pass], report: Report
    ) -> Verdict:
        """Run the same pass on what it left: there must be nothing more to do."""
        try:
            again = self._run(passes, report.model)
        except Me2eError as error:
            return say("crash", detail=f"on its own result: {error}")
        if count := sum(step.changes for step in again.steps):
            notes = "; ".join(note for step in again.steps for note in step.notes)
            return say("changes-again", detail=f"{count} changes: {notes}")
        return say("right")

    def _interface(self, runner: Runner) -> str:
        """Say what became of the inputs and outputs; empty if nothing."""
        before = self.answers.runner
        for what, old, new in (
            ("inputs", _types(before), _types(runner)),
            ("outputs", before.output_types, runner.output_types),
        ):
            if list(old.items()) != list(new.items()):
                return f"{what} {old} became {new}"
        return ""

    def _compared(self, runner: Runner, count: int) -> tuple[Kind, str]:
        shaky = ""
        for at in range(count):
            found = runner.run(self.answers.feeds[at])
            gaps = self.answers.off(at, found)
            if not gaps:
                continue
            worst = max(gaps, key=lambda name: gaps[name])
            said = f"{worst} is off by {gaps[worst]:.3g} at batch {self.sizes[at]}"
            if self.answers.is_steady(at, gaps):
                return "wrong", said
            shaky = said
        return ("unstable", shaky) if shaky else ("right", "")


def _types(runner: Runner) -> dict[str, str]:
    return {name: kind for name, (kind, _) in runner.inputs.items()}


def judge(model: onnx.ModelProto, pipeline: str, seed: int = 0) -> Verdict:
    """Judge one pipeline on one graph."""
    try:
        case = Case(model, seed)
    except RefusedError as error:
        return Verdict("invalid-draw", pipeline, str(error))
    return case.judge(pipeline)


def judged(
    seed: int, model: onnx.ModelProto, pipelines: Sequence[str]
) -> Iterator[Verdict]:
    """Judge a drawn graph by some pipelines."""
    try:
        case = Case(model, seed)
    except RefusedError as error:
        yield Verdict("invalid-draw", "", str(error))
        return
    yield from map(case.judge, pipelines)


def shrunk(model: onnx.ModelProto, kind_of: Callable[[onnx.ModelProto], Kind]) -> str:
    """Write, in ONNX's syntax, a part of a graph of which the verdict is the same."""
    kind, whole = kind_of(model), ir.from_proto(model)
    graph.infer_shapes(whole)
    small = shrink(whole, lambda part: kind_of(ir.to_proto(part)) == kind)
    return onnx.printer.to_text(ir.to_proto(small))


def report(seed: int, found: Verdict) -> str:
    """Tell a finding, with a part of the graph that shows it."""
    whole = drawing(seed)
    text = shrunk(whole.model, lambda part: judge(part, found.pipeline, seed).kind)
    return (
        f"seed {seed} ({', '.join(whole.motifs)}), pipeline {found.pipeline}\n"
        f"{found.kind}: {found.detail}\n{text}"
    )
