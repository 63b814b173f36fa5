"""Do two graphs give the same outputs?"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.calibration.dataset import synthetic
from me2e_compress.calibration.stream import Recording
from me2e_compress.errors import GraphError
from me2e_compress.graph.shapes import is_static
from me2e_compress.manager.report import Verification
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, detached, replay

TOLERANCES = {"float64": 1e-9, "float32": 1e-4, "float16": 1e-2, "bfloat16": 5e-2}
"""Allowed max|a-b|/max|a| by output dtype: what reordered sums of that dtype cost in
networks of a few hundred layers (float32: 1e-6 to 1e-5 measured on VAD-tiny); every
other dtype must be equal."""

NUDGES, NUDGE_ULPS = 3, 4
"""How often, and by how many units in the last place, inputs are nudged to see what
rounding alone does to an output."""

Outputs = dict[str, npt.NDArray[np.generic]]


@dataclasses.dataclass(frozen=True)
class VerificationInputs:
    """The inputs that two graphs are compared on.

    Attributes:
        frames: what is fed, in order.
        kind: ``recorded`` or ``synthetic``.
        provider: what runs both.
    """

    frames: Sequence[Frame]
    kind: str
    provider: Provider = CPU

    @classmethod
    def of(
        cls,
        model: ir.Model,
        frames: Recording | None,
        seed: int,
        count: int,
        successor: ir.Model | None = None,
        provider: Provider = CPU,
    ) -> "VerificationInputs":
        """Take the first recorded frames, or make seeded inputs where none are given.

        Args:
            model: the graph.
            frames: the recording; None makes inputs up.
            seed: of those.
            count: how many frames.
            successor: what passes made of the graph: where its inputs have the sizes
                that the graph leaves open, those are taken.
            provider: what runs the graphs.

        Raises:
            PreconditionError: none are given and the inputs have no static shape.
        """
        if frames is not None:
            chosen = [frames[i] for i in range(min(count, len(frames)))]
            return cls(chosen, "recorded", provider)
        if successor is not None and not is_static(model):
            model = successor
        made = list(synthetic(model, seed=seed, count=count))
        return cls(made, "synthetic", provider)

    def run(self, model: ir.Model) -> Iterator[Outputs]:
        """Run a graph over the frames, recurrent state fed forward.

        Yields:
            The outputs of every frame, which are the caller's to keep.

        Raises:
            GraphError: onnxruntime cannot run it, or an output is no tensor.
        """
        session = Session(model, provider=self.provider)
        for outputs in replay(session, self.frames):
            for name, value in outputs.items():
                if not isinstance(value, np.ndarray):
                    raise GraphError(f"output {name} is no tensor: not compared")
            yield detached(outputs)

    def nudged(self, seed: int) -> "VerificationInputs":
        """Move every float of the inputs by a few units in its last place."""
        signs = np.random.default_rng(seed)
        frames = [
            dataclasses.replace(
                frame, arrays={k: _nudge(v, signs) for k, v in frame.arrays.items()}
            )
            for frame in self.frames
        ]
        return VerificationInputs(frames, self.kind, self.provider)


def _nudge(
    values: npt.NDArray[np.generic], signs: np.random.Generator
) -> npt.NDArray[np.generic]:
    if values.dtype.kind != "f":
        return values
    moved = signs.choice((-NUDGE_ULPS, NUDGE_ULPS), values.shape)
    return np.asarray(values + moved * np.spacing(values), values.dtype)


def errors(a: Iterable[Outputs], b: Iterable[Outputs]) -> dict[str, float]:
    """Measure max|a-b|/max|a| of every output over all frames, in float64.

    NaN and infinities count as equal where both graphs give the same one; anything
    else that is not a number makes the error infinite.
    """
    worst: dict[str, float] = {}
    for left, right in zip(a, b, strict=True):
        for name, value in left.items():
            worst[name] = max(worst.get(name, 0.0), relative(value, right[name]))
    return worst


def relative(a: npt.NDArray[np.generic], b: npt.NDArray[np.generic]) -> float:
    """Give max|a-b|/max|a|; infinite where shapes or kinds differ."""
    if a.shape != b.shape or a.dtype != b.dtype:
        return float("inf")
    if a.size == 0:
        return 0.0
    if a.dtype.kind not in "fcV" and a.dtype.name not in TOLERANCES:
        return 0.0 if np.array_equal(a, b) else float("inf")
    wide = np.complex128 if a.dtype.kind == "c" else np.float64
    x, y = a.astype(wide), b.astype(wide)
    finite = np.isfinite(x)
    if not np.array_equal(finite, np.isfinite(y)):
        return float("inf")
    if not np.array_equal(x[~finite], y[~finite], equal_nan=True):
        return float("inf")
    if not finite.any():
        return 0.0
    gap, scale = np.abs(x[finite] - y[finite]).max(), np.abs(x[finite]).max()
    if gap == 0.0:
        return 0.0
    return float(gap / scale) if scale > 0 else float("inf")


def tolerances(outputs: Outputs) -> dict[str, float]:
    """Look up what each output may differ by."""
    return {name: TOLERANCES.get(v.dtype.name, 0.0) for name, v in outputs.items()}


def verify(
    passes: tuple[str, ...],
    before: ir.Model,
    after: ir.Model,
    inputs: VerificationInputs,
) -> Verification:
    """Compare two graphs on the same inputs; one that no longer runs differs by inf.

    An output that differs is held against what rounding does to it: where the graph
    before moves as far when its inputs change in their last places (a choice between
    candidates that are nearly equal), that output tells nothing about the passes, and
    is named as unsteady. Outputs that are steady are judged all the same.
    """
    left = list(inputs.run(before))  # its session is gone before the next one opens
    allowed = tolerances(left[0])
    try:
        gaps = errors(left, inputs.run(after))
    except GraphError:
        gaps = dict.fromkeys(left[0], float("inf"))
        return Verification(passes, inputs.kind, gaps, allowed)
    found = Verification(passes, inputs.kind, gaps, allowed)
    if passed(found):
        return found
    rounding = unsteadiness(before, left, inputs)
    unsteady = tuple(
        name
        for name, error in found.errors.items()
        if allowed[name] < error <= rounding[name]
    )
    return dataclasses.replace(found, unsteady=unsteady)


def unsteadiness(
    model: ir.Model, answers: Sequence[Outputs], inputs: VerificationInputs
) -> dict[str, float]:
    """Measure how far each output moves when inputs change in their last places.

    Args:
        model: the graph.
        answers: what it gave on them.
        inputs: what it was fed.

    Returns:
        Output name -> the largest max|a-b|/max|a| of ``NUDGES`` trials.
    """
    session = Session(model, provider=inputs.provider)
    worst = dict.fromkeys(answers[0], 0.0)
    for seed in range(NUDGES):
        moved = errors(answers, replay(session, inputs.nudged(seed).frames))
        worst = {name: max(worst[name], moved[name]) for name in worst}
    return worst


def skipped(passes: tuple[str, ...], why: str) -> Verification:
    """Say that nothing was measured, and why."""
    return Verification(passes, "none", {}, {}, why)


def passed(result: Verification) -> bool:
    """Say whether every output that is steady stayed within its tolerance."""
    return all(
        error <= result.tolerances[name] or name in result.unsteady
        for name, error in result.errors.items()
    )
