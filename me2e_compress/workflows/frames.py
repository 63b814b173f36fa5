"""Calibration frames, coherent in time, seen by six cameras."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

from me2e_compress import graph
from me2e_compress.calibration.recording import Begin, Source, write_recording
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.version import __version__
from me2e_compress.workflows.checks import check_count, check_folder, model_path
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.extras import need_closed_loop
from me2e_compress.workflows.first_try import try_file
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Table
from me2e_compress.zoo.stacks import STACKS, find
from me2e_compress.zoo.synthetic_frames import frames as synthetic

SCENE_LENGTH = 8
"""Frames of a synthetic scene, half a second apart."""
DRIVEN_SCENE_LENGTH = 16
"""Frames of a stretch of a route, half a second apart."""


@dataclasses.dataclass(frozen=True)
class FramesOptions:
    """Which frames are made.

    Attributes:
        count: how many.
        seed: of everything.
        scene_length: frames a scene; None is `SCENE_LENGTH` of a synthetic world,
            `DRIVEN_SCENE_LENGTH` of a driven route.
        force: replace outputs that are not as we left them, too.
        provider: what opens the model whose frames they are.

    Raises:
        RecipeError: a seed below 0.
    """

    count: int = 256
    seed: int = 0
    scene_length: int | None = None
    force: bool = False
    provider: Provider = CPU

    def __post_init__(self) -> None:
        """Check the seed."""
        check_count("--seed", self.seed)


@dataclasses.dataclass(frozen=True, repr=False)
class FramesResult(Result):
    """A recording that was written.

    Attributes:
        stack: or model, whose frames they are.
        output: the folder.
        options: which frames.
    """

    stack: str
    output: Path
    options: FramesOptions

    @property
    def headline(self) -> str:
        """Folder, frames, stack, seed."""
        count, seed = self.options.count, self.options.seed
        return f"{self.output}: {count} frames of {self.stack}, seed {seed}"

    def tables(self) -> tuple[Table, ...]:
        """Return none: the line says it."""
        return ()

    def records(self) -> list[dict[str, object]]:
        """Return one row: the recording."""
        return [
            {
                "stack": self.stack,
                "output": self.output,
                "frames": self.options.count,
                "seed": self.options.seed,
            }
        ]

    def to_json(self) -> object:
        """Return the recording: stack, folder, frames, seed."""
        return self.records()[0]


def record_frames(
    source: str | Path,
    folder: str | Path,
    options: FramesOptions | None = None,
    listener: Listener = SILENT,
) -> Path:
    """Make frames of a stack or a driver and write them, all or nothing.

    A run that was killed goes on after its last whole scene.

    Of ``vad-tiny`` and ``tcp`` a synthetic world is drawn; for ``highway``, or any
    ONNX file that keeps the policy contract, the expert drives fresh routes of
    highway-env.

    Args:
        source: a stack of the zoo, or an ONNX file that keeps the policy contract.
        folder: is written.
        options: None takes the defaults.
        listener: is called with progress and warnings.

    Returns:
        The folder.

    Raises:
        GraphError: no such stack and no such file, or altered weights; or the folder
            is the input.
        FramesError: a count below 1, or the folder holds something else.
        EvaluationError: the file does not keep the policy contract.
        ProviderError: the provider is not there.
        MissingExtraError: driving needs the extra ``highway``.
    """
    options, folder = options or FramesOptions(), Path(folder)
    check_folder(folder, (source,))
    with writing(trees=[folder], force=options.force):
        return _recorded(source, folder, options, listener)


def _recorded(
    source: str | Path, folder: Path, options: FramesOptions, listener: Listener
) -> Path:
    if Path(source).is_file() or find(str(source)).trained:
        model = model_path(source)
        try_file(model, listener, options.provider)
        make, of = _driven(model, options), graph.sha256_of(model)
    else:
        make, of = _synthetic(str(source), options), str(source)
    about: dict[str, str | int] = {"stack": str(source), "seed": options.seed}

    def reported(begin: Begin) -> Iterator[Frame]:
        for frame in make(begin):
            yield frame
            done = frame.index + 1
            listener.on_progress("frames", done, options.count, folder.name)

    key = f"{__version__} {of} {options.count} {options.scene_length}"
    return write_recording(folder, reported, about, key)


def _driven(model: Path, options: FramesOptions) -> Source:
    need_closed_loop("what frames of a driver need")
    from me2e_compress.driving.onnx_policy import OnnxPolicy
    from me2e_compress.evaluators.highway.driven_frames import driven_frames

    policy = OnnxPolicy.open(model, provider=options.provider)
    length = options.scene_length
    return lambda begin: driven_frames(
        policy,
        options.count,
        seed=options.seed,
        scene_length=DRIVEN_SCENE_LENGTH if length is None else length,
        done=begin.frame,
        first=begin.place,
    )


def _synthetic(stack: str, options: FramesOptions) -> Source:
    length = SCENE_LENGTH if options.scene_length is None else options.scene_length

    def make(begin: Begin) -> Iterator[Frame]:
        first = begin.frame
        made = synthetic(STACKS[stack], options.count, options.seed, length, first)
        for index, arrays in enumerate(made, first):
            yield Frame(index, index % length == 0, dict(arrays))

    return make
