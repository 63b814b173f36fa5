"""What two graphs are compared on, and how far their outputs may be apart.

The inputs are recorded frames, or seeded ones of drawn sizes.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import FramesError, GraphError, PreconditionError
from me2e_compress.calibration.dataset import CalibrationSet, digest_of, draw_frames
from me2e_compress.graph.shapes import static_shape
from me2e_compress.passes.fix_shapes import open_dimensions, sized_inputs
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, detached, replay

TOLERANCES = {"float64": 1e-9, "float32": 1e-4, "float16": 1e-2, "bfloat16": 5e-2}
"""Allowed max|a-b|/max|a| by output dtype: what reordered sums of that dtype cost in
networks of a few hundred layers (float32: 1e-6 to 1e-5 measured on VAD-tiny); every
other dtype must be equal."""

NUDGE_ULPS = 4
"""Units in the last place by which inputs are nudged."""
NUDGES = 3
"""How often inputs are nudged to see what rounding alone does to an output."""
SIZE_TRIALS = 2
"""Number of sizes at which a graph with open dimensions is run."""
DISTINCT_SIZES = (2, 3, 5, 7, 11, 13)
"""Sizes that are all different: what mixes up two open dimensions shows."""
EQUAL_SIZES = (
    *((2, 2), (3, 3), (1, 1)),
    *(
        (lead, size)
        for size in (4, 8, 16, 32, 64, 128, 224, 256, 512)
        for lead in (2, 1)
    ),
)
"""Sizes of leading dimensions (batches), and of all others: where the graph wants some
of them to be equal, or pictures that can be halved again and again."""
MOST_ELEMENTS = 1 << 25
"""Most numbers of drawn inputs: 128 MB of float32."""

Outputs: TypeAlias = Mapping[str, npt.NDArray[np.generic]]
Sizes: TypeAlias = Mapping[str, int]
Answers: TypeAlias = dict[str, list[tuple[Frame, Outputs]]]
"""What graphs answered to frames of one scene, by digest of the graph."""


@dataclasses.dataclass(frozen=True)
class VerificationInputs:
    """The inputs that two graphs are compared on.

    Attributes:
        frames: what is fed, in order.
        kind: ``recorded`` or ``synthetic``.
        provider: what runs both.
        sizes: of open dimensions that were drawn, one scene of frames each.
        answers: graphs are not run again on frames that they answered.
    """

    frames: Sequence[Frame]
    kind: str
    provider: Provider = CPU
    sizes: tuple[Sizes, ...] = ()
    answers: Answers = dataclasses.field(default_factory=dict, compare=False)

    @classmethod
    def of(
        cls,
        model: ir.Model,
        frames: CalibrationSet | None,
        seed: int,
        count: int,
        provider: Provider = CPU,
    ) -> "VerificationInputs":
        """Take the first recorded frames, or make seeded inputs where none are given.

        Open dimensions are given two sizes that the graph runs at, one after the other:
        ``count`` frames of each.

        Raises:
            PreconditionError: none are given, and the inputs are of unknown rank or no
                numbers, or the graph runs at no drawn size.
            GraphError: onnxruntime cannot open the graph to try sizes.
        """
        if frames is not None:
            first = [frames[index] for index in range(min(count, len(frames)))]
            return cls(first, "recorded", provider)
        if open_dimensions(model):
            scenes = _runnable_scenes(model, seed, count, provider)
            made = [frame for _, scene in scenes for frame in scene]
            sizes = tuple(sizes for sizes, _ in scenes)
            return cls(made, "synthetic", provider, sizes)
        return cls(
            list(draw_frames(model, seed=seed, count=count)), "synthetic", provider
        )

    def run(self, model: ir.Model, *, optimize: bool = True) -> Iterator[Outputs]:
        """Run a graph over the frames, recurrent state fed forward.

        Yields:
            The outputs of every frame, which are the caller's to keep.

        Raises:
            GraphError: onnxruntime cannot run it, or an output is no tensor.
        """
        known = self.answers.get(graph.digest(model), []) if optimize else []
        if list(map(_content, self.frames)) == [_content(frame) for frame, _ in known]:
            yield from (outputs for _, outputs in known)
            return
        session = Session(
            model, optimize=optimize, release=True, provider=self.provider
        )
        yield from map(tensors_of, replay(session, self.frames))

    def nudged(self, seed: int) -> "VerificationInputs":
        """Move every float of the inputs by a few units in its last place."""
        signs = np.random.default_rng(seed)
        frames = [
            dataclasses.replace(
                frame, arrays={k: nudge(v, signs) for k, v in frame.arrays.items()}
            )
            for frame in self.frames
        ]
        return dataclasses.replace(self, frames=frames)


def _content(frame: Frame) -> tuple[object, ...]:
    arrays = frame.arrays.items()
    return frame.starts_scene, *((name, digest_of(array)) for name, array in arrays)


def tensors_of(outputs: Outputs) -> Outputs:
    """Return copies of what a session gave; a GraphError for what is no tensor."""
    for name, value in outputs.items():
        if not isinstance(value, np.ndarray):
            raise GraphError(f"output {name} is no tensor: not compared")
    return detached(outputs)


def resize_as(model: ir.Model, other: ir.Model) -> ir.Model:
    """Return a graph whose open inputs have the sizes of another's; maybe itself."""
    sized = {each.name: each.shape for each in other.graph.inputs}
    wanted = {
        at: shape
        for at, each in enumerate(model.graph.inputs)
        if static_shape(each) is None
        and (shape := sized.get(each.name)) is not None
        and shape != each.shape
    }
    if not wanted:
        return model
    copy = model.clone()
    for at, shape in wanted.items():
        copy.graph.inputs[at].shape = shape
    return copy


def seeded_frames(model: ir.Model, seed: int, count: int) -> tuple[Frame, ...] | None:
    """Return drawn frames; None if an input has an open shape or is not numeric."""
    try:
        return tuple(draw_frames(model, seed=seed, count=count))
    except PreconditionError:
        return None


def nudge(
    values: npt.NDArray[np.generic], signs: np.random.Generator
) -> npt.NDArray[np.generic]:
    """Move floats by a few units in their last place, up or down."""
    if values.dtype.kind != "f":
        return values
    moved = signs.choice((-NUDGE_ULPS, NUDGE_ULPS), values.shape)
    return np.asarray(values + moved * np.spacing(values), values.dtype)


def _runnable_scenes(
    model: ir.Model, seed: int, count: int, provider: Provider
) -> list[tuple[Sizes, list[Frame]]]:
    """Return sizes that a graph runs at, with scenes; a PreconditionError if none."""
    session, reason = Session(model, release=True, provider=provider), ""
    scenes: list[tuple[Sizes, list[Frame]]] = []
    for sizes in size_candidates(model):
        inputs = sized_inputs(model, sizes)
        made = [math.prod(static_shape(each) or ()) for each in inputs.graph.inputs]
        if sum(made) > MOST_ELEMENTS:
            continue
        scene = list(draw_frames(inputs, seed=seed + len(scenes), count=count))
        try:
            for _ in replay(session, scene):
                pass  # to run is all that is asked
        except (GraphError, FramesError) as error:
            reason = reason or f" ({error})"
            continue
        scenes.append((sizes, scene))
        if len(scenes) == SIZE_TRIALS:
            break
    if not scenes:
        names = ", ".join(open_dimensions(model))
        raise PreconditionError(
            f"the graph runs at none of the sizes that were tried for {names}{reason};"
            " give frames instead, or sizes (compress --set-dim)"
        )
    return scenes


def size_candidates(model: ir.Model) -> Iterator[Sizes]:
    """Yield sizes of the open dimensions of a graph's inputs, the likeliest first."""
    axes = open_dimensions(model)
    for start in range(SIZE_TRIALS):
        sizes = itertools.islice(itertools.cycle(DISTINCT_SIZES), start, None)
        yield dict(zip(axes, sizes, strict=False))
    for lead, other in EQUAL_SIZES:
        yield {name: other if axis else lead for name, axis in axes.items()}


def relative_errors(a: Iterable[Outputs], b: Iterable[Outputs]) -> dict[str, float]:
    """Measure max|a-b|/max|a| of every output over all frames, in float64.

    NaN and infinities count as equal where both graphs give the same one; anything
    else that is not a number makes the error infinite.
    """
    worst: dict[str, float] = {}
    for left, right in zip(a, b, strict=True):
        for name, value in left.items():
            worst[name] = max(worst.get(name, 0.0), relative_error(value, right[name]))
    return worst


def relative_error(a: npt.NDArray[np.generic], b: npt.NDArray[np.generic]) -> float:
    """Return max|a-b|/max|a|; infinite where shapes or dtypes differ."""
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
    return 0.0 if gap == 0.0 else float(gap / scale) if scale > 0 else math.inf


def tolerances(outputs: Outputs) -> dict[str, float]:
    """Return the largest relative error that each output may have, by its dtype."""
    return {name: TOLERANCES.get(v.dtype.name, 0.0) for name, v in outputs.items()}
