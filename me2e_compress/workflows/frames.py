"""Make calibration frames that are coherent in time."""

import dataclasses
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

from me2e_compress.calibration.dataset import PixelInput
from me2e_compress.calibration.recording import (
    LOGS,
    Begin,
    DriveLog,
    LogRequest,
    Source,
    partial_of,
    write_recording,
)
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.errors import FramesError
from me2e_compress.extras import need_extra
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.version import __version__
from me2e_compress.workflows.checks import check_count, check_folder, model_path
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.first_opening import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, counted

DRIVEN_SCENE_LENGTH = 16
"""Frames of a stretch of a route, half a second apart."""


@dataclasses.dataclass(frozen=True)
class FramesOptions:
    """Which frames are made.

    Attributes:
        count: number of frames.
        seed: seed of everything random.
        scene_length: frames a scene; None is `DRIVEN_SCENE_LENGTH` of a driven route,
            all that a log has.
        force: replace outputs that we did not write, too.
        provider: what opens the model whose frames they are.
        log: recorded driving that they are made from; None lets the expert drive.
        adapter: TOML file that adapts an ONNX file to the policy contract, or the name
            of one that ships: the frames are in the model's own form.
    """

    count: int = 256
    seed: int = 0
    scene_length: int | None = None
    force: bool = False
    provider: Provider = CPU
    log: DriveLog | None = None
    adapter: Path | None = None

    def __post_init__(self) -> None:
        check_count("--seed", self.seed)


@dataclasses.dataclass(frozen=True, repr=False)
class FramesResult(Result):
    """A recording that was written for a model."""

    stack: str
    output: Path
    options: FramesOptions

    @property
    def count(self) -> int:
        """The number of frames written: a log may have fewer than were asked for."""
        return sum(1 for _ in self.output.glob("*.npz"))

    @property
    def headline(self) -> str:
        """The folder, its frames, the model, and the seed or log."""
        log, seed = self.options.log, self.options.seed
        said = f"{self.output}: {counted(self.count, 'frame')} of {self.stack}"
        return f"{said}, {f'seed {seed}' if log is None else f'from {LOGS.text(log)}'}"

    def to_json(self) -> object:
        """Return the recording: stack, folder, frames, seed, log."""
        log = self.options.log
        return {
            "stack": self.stack,
            "output": self.output,
            "frames": self.count,
            "seed": self.options.seed if log is None else None,
            "log": None if log is None else LOGS.text(log),
        }


def record_frames(
    source: str | Path,
    folder: str | Path,
    options: FramesOptions | None = None,
    listener: Listener = SILENT,
) -> Path:
    """Make frames of a driver and write them, all or nothing.

    For a driver that ships, or any ONNX file that keeps the policy contract, the expert
    drives fresh routes of highway-env. With a log, recorded driving is laid out as the
    file takes it. A run that was killed goes on after its last whole scene. The folder
    is returned.

    Raises:
        GraphError: The file is missing or altered, or the folder is the input.
        FramesError: The count is below 1, the folder holds something else, the log
            cannot feed the model.
        EvaluationError: The file does not keep the policy contract, or the adapter
            adapts nothing.
        ProviderError: The provider is not available.
        MissingExtraError: Driving needs the extra ``highway``.
    """
    options, folder = options or FramesOptions(), Path(folder)
    if not folder.name:
        raise FramesError(f"{folder}: name a folder of its own: it is written anew")
    check_folder(folder, (source, options.adapter))
    with writing(trees=[folder], folders=[partial_of(folder)], force=options.force):
        return _recorded(source, folder, options, listener)


def _recorded(
    source: str | Path, folder: Path, options: FramesOptions, listener: Listener
) -> Path:
    pixels: Mapping[str, PixelInput] = {}
    about: dict[str, str | int] = {"stack": str(source), "seed": options.seed}
    # frames come from a log, or from the expert's driving
    if options.log is not None:
        make, of, pixels = _logged(source, options.log, options)
        about = {"stack": str(source), "log": LOGS.text(options.log)}
    else:
        model = model_path(source)
        try_first(model, model.name, listener=listener, provider=options.provider)
        make, of = _driven(model, options), sha256_of(model)
    # a recording is continued only if the sources and the adapter are the same
    if options.adapter is not None:
        of += f" {Adapter.digest(adapter_file(options.adapter))}"

    def reported(begin: Begin) -> Iterator[Frame]:
        for frame in make(begin):
            yield frame
            done = frame.index + 1
            listener.on_progress("frames", done, options.count, folder.name)

    key = f"{__version__} {of} {options.count} {options.scene_length}"
    return write_recording(folder, reported, about, key, pixels)


def _logged(
    source: str | Path, log: DriveLog, options: FramesOptions
) -> tuple[Source, str, Mapping[str, PixelInput]]:
    request = LogRequest(
        model_path(source),
        options.count,
        options.scene_length,
        None if options.adapter is None else adapter_file(options.adapter),
        options.provider,
    )
    return (
        partial(log.frames, request),
        sha256_of(request.model),
        log.pixels(request),
    )


def _policy(model: Path, options: FramesOptions) -> OnnxPolicy:
    adapter = None
    if options.adapter is not None:
        adapter = Adapter.load(adapter_file(options.adapter))
    return OnnxPolicy.open(model, adapter, options.provider)


def _driven(model: Path, options: FramesOptions) -> Source:
    need_extra("highway", "recording frames of a driver")
    from me2e_compress.evaluators.highway.driven_frames import driven_frames

    policy, length = _policy(model, options), options.scene_length
    return lambda begin: driven_frames(
        policy,
        options.count,
        seed=options.seed,
        scene_length=DRIVEN_SCENE_LENGTH if length is None else length,
        done=begin.frame,
        first=begin.place,
    )
