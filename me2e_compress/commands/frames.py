"""Make calibration frames that are coherent in time."""

import dataclasses
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Self

from me2e_compress.base.display import plural
from me2e_compress.base.errors import FramesError
from me2e_compress.base.extras import require_extra
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.calibration.dataset import PixelInput
from me2e_compress.calibration.recording import (
    LOGS,
    Begin,
    LogRequest,
    Source,
    partial_folder,
    write_recording,
)
from me2e_compress.commands.checks import check_folder, model_path, try_first, writing
from me2e_compress.commands.options import FramesOptions
from me2e_compress.commands.result import Result
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.adapter.outputs import write_port_metadata
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.graph import load, sha256_of
from me2e_compress.runtime.frames import Frame
from me2e_compress.shipped.drivers import shipped_model
from me2e_compress.version import __version__

DRIVEN_SCENE_LENGTH = 16  # frames of a stretch of a route, half a second apart


@dataclasses.dataclass(frozen=True, repr=False)
class FramesResult(Result):
    """A recording that was written for a model."""

    stack: str
    output: Path
    frames: int  # a log may have fewer than were asked for
    seed: int | None = None  # None for a log
    log: str | None = None  # the log that they are from, as text

    @classmethod
    def of(cls, stack: str, output: Path, options: FramesOptions) -> Self:
        """Count what was written."""
        count = sum(1 for _ in output.glob("*.npz"))
        if options.log is None:
            return cls(stack, output, count, options.seed)
        return cls(stack, output, count, log=LOGS.text(LOGS.parse(options.log)))

    @property
    def headline(self) -> str:
        """The folder, its frames, the model, and the seed or log."""
        by = f"seed {self.seed}" if self.log is None else f"from {self.log}"
        count = plural(self.frames, "frame")
        return f"{self.output}: {count} of {self.stack}, {by}"


def record_frames(
    source: str | Path,
    folder: str | Path,
    options: FramesOptions | None = None,
    listener: Listener = SILENT,
) -> Path:
    """Make frames of a driver and write them, all or nothing.

    The driver that ships drives fresh routes of highway-env, and the model looks on: a
    driver that ships, or any ONNX file that keeps the policy contract. With a log,
    recorded driving is laid out as the file takes it. A run that was killed goes on
    after its last whole scene. The folder is returned.

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
    log = None if options.log is None else LOGS.parse(options.log)
    if not folder.name:
        raise FramesError(f"{folder}: name a folder of its own: it is written anew")
    check_folder(folder, (source, options.adapter))
    with writing(trees=[folder], folders=[partial_folder(folder)], force=options.force):
        model = model_path(source)
        digests, adapter = sha256_of(model), None
        pixels: Mapping[str, PixelInput] = {}
        # A recording goes on only if its sources and the adapter are the same
        if options.adapter is not None:
            adapter = adapter_file(Path(options.adapter))
            digests += f" {sha256_of(adapter)}"
        about: dict[str, str | int] = {"stack": str(source)}
        if log is not None:
            # Frames of a log, laid out as the model takes them
            request = LogRequest(
                model, options.count, options.scene_length, adapter, options.runs_on
            )
            frames_from: Source = partial(log.frames, request)
            pixels, about["log"] = log.pixels(request), LOGS.text(log)
        else:
            # Frames of a drive: the shipped driver drives, the model looks on
            try_first(model, model.name, listener=listener, provider=options.runs_on)
            metadata = write_port_metadata(load(model), None, options.module_map)
            digests += f" {metadata}" if metadata else ""
            about["seed"] = options.seed
            frames_from = _drive_source(model, adapter, metadata, options)

        def with_progress(begin: Begin) -> Iterator[Frame]:
            for frame in frames_from(begin):
                yield frame
                done = frame.index + 1
                listener.on_progress("frames", done, options.count, folder.name)

        key = f"{__version__} {digests} {options.count} {options.scene_length}"
        return write_recording(folder, with_progress, about, key, pixels)


def _drive_source(
    model: Path,
    adapter: Path | None,
    metadata: Mapping[str, str],
    options: FramesOptions,
) -> Source:
    """Return what drives the shipped driver and yields the model's inputs."""
    require_extra("highway", "recording frames of a driver")
    from me2e_compress.evaluators.highway.driven_frames import driven_frames

    loaded = None if adapter is None else Adapter.load(adapter)
    policy = OnnxPolicy.open(model, loaded, options.runs_on, metadata=metadata)
    driver = OnnxPolicy.open(shipped_model("highway"))
    length = options.scene_length
    return lambda begin: driven_frames(
        policy,
        driver,
        options.count,
        seed=options.seed,
        scene_length=DRIVEN_SCENE_LENGTH if length is None else length,
        done=begin.frame,
        first=begin.place,
    )
