"""The pass manager: clone, run, check, commit; verify exact passes; name culprits."""

import contextlib
import dataclasses
import gc
from collections.abc import Callable, Iterator
from pathlib import Path
from time import process_time

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import (
    GraphError,
    Me2eError,
    PassError,
    PreconditionError,
    VerificationError,
)
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.graph.opset import read_as
from me2e_compress.manager import equivalence, reproducer
from me2e_compress.manager.attempt import attempt, blame_file
from me2e_compress.manager.equivalence import TryFirst
from me2e_compress.manager.recipe import to_text
from me2e_compress.manager.report import LossyPass, Report, Step, Verification
from me2e_compress.manager.verification_inputs import (
    Answers,
    VerificationInputs,
    resize_as,
    seeded_frames,
)
from me2e_compress.passes.base import Context, Pass
from me2e_compress.passes.import_normalize import ImportNormalize, needs_import

NOT_REQUESTED = "no frame was asked for (--verify-frames 0)"

Progress = Callable[[int, int, str], None]
Stretch = list[tuple[Pass, ir.Model]]


@dataclasses.dataclass(frozen=True)
class PassManager:
    """Runs passes in order and stops at the first that breaks its contract.

    Attributes:
        passes: what to run. ``import-normalize`` is put in front of a graph whose
            nodes do not say yet where they come from.
        verify_frames: how many frames exact passes are checked on; 0 turns it off,
            and the report says that they are not proven.
        reproducers: the folder that a failing pass leaves its reproducer in.
        samples: recorded frames that exact passes are checked on where the context has
            none; None makes seeded inputs up then.
        try_first: called with a graph, its name and frames before it is run on them;
            may refuse it.
        answers: what graphs answered on frames, which others know or may ask.
    """

    passes: tuple[Pass, ...]
    verify_frames: int = 2
    reproducers: Path | None = None
    samples: CalibrationSet | None = None
    try_first: TryFirst | None = None
    answers: Answers = dataclasses.field(default_factory=dict, compare=False)

    def run(
        self, model: ir.Model, context: Context, progress: Progress | None = None
    ) -> Report:
        """Apply every pass to a copy of the model.

        Args:
            model: the graph; it stays as it is.
            context: module map, frames, seed.
            progress: called as ``progress(done, total, what)``.

        Raises:
            Me2eError: a pass refused the graph (the message says why).
            PassError: a pass broke.
            VerificationError: a pass broke the contract or changed the outputs.
        """
        with pause_collector():
            report_progress = progress or (lambda done, total, what: None)
            report = self._run(model.clone(), context, report_progress)
            return dataclasses.replace(report, read_as=read_as(model))

    def _run(self, model: ir.Model, context: Context, progress: Progress) -> Report:
        """Run the passes on this very model; see :meth:`run`."""
        graph.infer_shapes(model)
        passes = self.passes
        first = passes[0].name if passes else ""
        if needs_import(model) and first != ImportNormalize.name:
            passes = (ImportNormalize(), *passes)
        run = _Run(self, context, progress, checkpoint=model)
        for done, current in enumerate(passes):
            progress(done, len(passes), current.name)
            if not current.exact:
                run.verify(model)
            model = run.transact(current, model)
        progress(len(passes), len(passes), "verify")
        run.verify(model)
        return Report(
            model,
            to_text(passes),
            tuple(run.steps),
            tuple(run.verifications),
            tuple(run.lossy),
        )


@contextlib.contextmanager
def pause_collector() -> Iterator[None]:
    """Pause Python's cycle collector: it would walk a million live nodes in vain.

    A quarter of a run goes into that otherwise; what is left is collected at its end.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


SEARCH_S = 300.0
"""CPU seconds after which passes that may be guilty are named together."""
_RECORD = (
    " where they are like none that the model sees, record some: compress MODEL"
    " --frames FRAMES"
)


class _Run:
    """The state of one run: steps done, and the stretch not verified yet."""

    def __init__(
        self,
        manager: PassManager,
        context: Context,
        progress: Progress,
        checkpoint: ir.Model,
    ) -> None:
        self.manager = manager
        self.context = context
        self.progress = progress
        self.steps: list[Step] = []
        self.verifications: list[Verification] = []
        self.lossy: list[LossyPass] = []
        self._stretch: Stretch = []
        self._unchecked: list[str] = []
        self._size = graph.size(checkpoint)
        self._digest = graph.digest(checkpoint)

    def transact(self, current: Pass, model: ir.Model) -> ir.Model:
        """Run one pass on a clone; return the clone only if all checks hold.

        The graph goes in, and comes out, with its shapes inferred.
        """
        # Run and check: a copy is changed, and the contract compares both.
        start = process_time()
        try:
            result, self._digest = attempt(current, model, self.context, self._digest)
        except (PassError, VerificationError) as error:
            blame_file(current.name, model, error)
            raise self._with_reproducer(current, model, error) from error.__cause__
        # Commit: what the next pass is given has its shapes, and is hashed once.
        size, self._size = self._size, graph.size(result.model)
        self.steps.append(
            Step(
                *(current.name, to_text((current,)), current.exact, result.changes),
                *(process_time() - start, size, self._size, result.notes),
            )
        )
        if not current.exact:
            self.lossy.append(LossyPass(current, model, result.changes))
        elif result.changes and self.manager.verify_frames:
            self._stretch.append((current, model))
        elif result.changes:  # nobody will ask for the graph before
            self._unchecked.append(current.name)
        return result.model

    def verify(self, model: ir.Model) -> None:
        """Verify the exact passes since the last time; raise with the culprit."""
        stretch, self._stretch = self._stretch, []
        if self._unchecked:
            names, self._unchecked = tuple(self._unchecked), []
            self.verifications.append(equivalence.unverified(names, NOT_REQUESTED))
        if not stretch:
            return
        # a size that a pass gave to an input holds before it, too
        stretch = [(current, resize_as(before, model)) for current, before in stretch]
        # what onnxruntime dies of is refused here, not merely unproven
        if self.manager.try_first is not None:
            what = f"the graph after {stretch[-1][0].name}"
            seed, count = self.context.seed, self.manager.verify_frames
            shown = self._frames() or seeded_frames(model, seed, count)
            self.manager.try_first(model, what, shown)
        check, runnable, inputs = self._compare(stretch, model)
        self.verifications.append(check)
        if check.passed or inputs is None:
            return
        suspects, guilty, changed = _bisect(runnable, model, inputs, self.progress)
        current, who = suspects[-1], " or ".join(each.name for each in suspects)
        worst = max(check.judged, key=lambda name: check.errors[name])
        drawn = inputs.kind == "synthetic"
        error = VerificationError(
            f"{who} promises the same outputs and changed {worst} by"
            f" {check.errors[worst]:.3g} of its range"
            f" (allowed {check.tolerances[worst]:.0e}, {check.inputs} inputs)"
            f"{equivalence.difference(guilty, changed, inputs)}"
            + (f"; inputs were drawn (seed {self.context.seed}):{_RECORD}" * drawn)
        )
        raise self._with_reproducer(current, guilty, error)

    def _compare(
        self, stretch: Stretch, model: ir.Model
    ) -> tuple[Verification, Stretch, VerificationInputs | None]:
        """Compare with the earliest graph that runs (import may make it runnable)."""
        context, frames = self.context, self._frames()
        count, reason = self.manager.verify_frames, ""
        for first, (_, before) in enumerate(stretch):
            names = tuple(current.name for current, _ in stretch[first:])
            try:
                inputs = VerificationInputs.of(
                    before, frames, context.seed, count, context.provider
                )
                inputs = dataclasses.replace(inputs, answers=self.manager.answers)
                check = equivalence.verify(names, before, model, inputs)
            except (GraphError, PreconditionError) as error:
                reason = reason or str(error)
                continue
            remarks = (*check.remarks, *self._leave_out(stretch[:first], reason))
            return dataclasses.replace(check, remarks=remarks), stretch[first:], inputs
        names = tuple(current.name for current, _ in stretch)
        return equivalence.unverified(names, reason), stretch, None

    def _frames(self) -> CalibrationSet | None:
        return self.context.frames or self.manager.samples

    def _leave_out(self, stretch: Stretch, reason: str) -> tuple[str, ...]:
        """Record what is not proven since the graph did not run before it.

        Of an import alone, which often makes an exported graph run, remarks are
        returned instead, with its notes.
        """
        names = tuple(current.name for current, _ in stretch)
        if set(names) - {ImportNormalize.name}:
            self.verifications.append(equivalence.unverified(names, reason))
            return ()
        notes = [n for each in self.steps if each.name in names for n in each.notes]
        begins = "what is proven begins with what it made"
        return tuple(f"not proven: {names[0]}, {n}: {reason}; {begins}" for n in notes)

    def _with_reproducer(
        self, current: Pass, model: ir.Model, error: Me2eError
    ) -> Me2eError:
        """Return the error with the path of its reproducer, which is written."""
        folder = self.manager.reproducers
        if folder is None:
            return error
        piece = reproducer.shrink(
            model, lambda part: _fails_same(current, part, self.context, error)
        )
        written = reproducer.write(
            folder, piece, to_text((current,)), self.context.seed, str(error)
        )
        return type(error)(f"{error}; reproducer ({len(piece.graph)} nodes): {written}")


def _bisect(
    stretch: Stretch, last: ir.Model, inputs: VerificationInputs, progress: Progress
) -> tuple[list[Pass], ir.Model, ir.Model]:
    """Find the first pass after which the outputs differ, in log2 trials.

    After ``SEARCH_S`` CPU seconds it stops. Returns the passes that are left, with the
    graph before and the graph after them.
    """
    models = [*(model for _, model in stretch), last]
    good, bad, begun = 0, len(stretch), process_time()
    while bad - good > 1 and process_time() - begun < SEARCH_S:
        progress(len(stretch) - (bad - good), len(stretch), "which pass it was")
        middle = (good + bad) // 2
        trial = equivalence.verify((), models[0], models[middle], inputs)
        good, bad = (middle, bad) if trial.passed else (good, middle)
    return [each for each, _ in stretch[good:bad]], models[good], models[bad]


def _fails_same(
    current: Pass, part: ir.Model, context: Context, error: Me2eError
) -> bool:
    """Return whether a part of the graph fails as the whole does."""
    try:
        result, _ = attempt(current, part, context)
    except Me2eError as other:
        return type(other) is type(error)
    if not current.exact or isinstance(error, PassError):
        return False
    try:
        inputs = VerificationInputs.of(
            part, None, context.seed, 1, provider=context.provider
        )
        return not equivalence.verify((), part, result.model, inputs).passed
    except (GraphError, PreconditionError):
        return False
