"""Recorded driving, which other packages read (docs/writing-logs.md)."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from me2e_compress.calibration.pixels import PixelInput
from me2e_compress.calibration.recording import Begin
from me2e_compress.errors import FramesError
from me2e_compress.registry import Registry
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.providers import CPU, Provider


@dataclass(frozen=True)
class LogRequest:
    """What frames a log is asked for.

    Attributes:
        model: the ONNX file, or the TOML of a stack, whose inputs they are.
        count: most frames in all.
        scene_length: most frames a scene; None means all.
        adapter: TOML file that adapts the model to the policy contract.
        provider: what opens the model.
    """

    model: Path
    count: int
    scene_length: int | None = None
    adapter: Path | None = None
    provider: Provider = CPU


@dataclass(frozen=True)
class DriveLog(ABC):
    """A data set of recorded driving."""

    name: ClassVar[str]

    @abstractmethod
    def frames(self, request: LogRequest, begin: Begin) -> Iterator[Frame]:
        """Yield frames of the model's inputs, from the beginning of a scene on.

        Raises:
            FramesError: something is missing or malformed, or does not fit the model.
        """

    def pixels(self, request: LogRequest) -> Mapping[str, PixelInput]:
        """Return the inputs that are yielded as bytes, by name."""
        return {}


LOGS: Registry[DriveLog] = Registry(
    "driving log", "me2e_compress.logs", FramesError, {}
)
