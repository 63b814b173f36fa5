"""How a model with its own names and layouts is adapted to the policy contract."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, ValidationError

from me2e_compress import documents
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.plan_adapter import PlanAdapter

IMAGE = "me2e.image"
"""Metadata key: JSON of `ImageNormalization`."""

Floats: TypeAlias = npt.NDArray[np.float32]
Triple: TypeAlias = tuple[float, float, float]
Contract: TypeAlias = Literal["img", "lidar2img", "can_bus", "command", "timestamp"]


class ImageNormalization(BaseModel):
    """How pixels become the image input: (pixel - mean) / std, channel by channel.

    Attributes:
        input: Name of the image input.
        mean: In grey levels 0 to 255, in the order of `order`.
        std: The same.
        order: Channels of the model: red first or blue first.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    input: str = "img"
    mean: Triple
    std: Triple
    order: Literal["rgb", "bgr"]

    def apply(self, images: npt.NDArray[np.uint8]) -> Floats:
        """Return float32 [1, 6, 3, H, W] of uint8 RGB [6, H, W, 3]."""
        planes = np.moveaxis(images, -1, 1)
        if self.order == "bgr":
            planes = planes[:, ::-1]
        # Reordering bytes and then converting is six times faster than both at once.
        ready = np.ascontiguousarray(planes).astype(np.float32)
        ready -= np.array(self.mean, np.float32)[:, None, None]
        ready /= np.array(self.std, np.float32)[:, None, None]
        return ready[None]


class Axes(StrEnum):
    """Ground frame of a model's waypoints and of its lidar2img."""

    FORWARD_LEFT = "forward-left"
    """x forward, y left: ours."""
    RIGHT_FORWARD = "right-forward"
    """x right, y forward: the lidar of nuScenes, of UniAD and of VAD."""

    @property
    def to_ego(self) -> npt.NDArray[np.float64]:
        """Rotation [3, 3] from this frame to the ego frame."""
        if self is Axes.FORWARD_LEFT:
            return np.eye(3)
        return np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class Adapter(BaseModel):
    """The contents of a TOML adapter; what is left out follows from the model.

    Attributes:
        inputs: The contract's name (img, lidar2img, can_bus, command, timestamp) to
            the graph's.
        recurrent: Recurrent input to the output that answers it.
        plan: Which output is the plan, whether it holds steps, which mode is taken;
            ``command_input = "command"`` lets the navigator's command pick it.
        image: Normalisation.
        axes: Ground frame of the model.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    inputs: dict[Contract, str] = {}
    recurrent: dict[str, str] | None = None
    plan: PlanAdapter | None = None
    image: ImageNormalization | None = None
    axes: Axes = Axes.FORWARD_LEFT

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file.

        Raises:
            EvaluationError: No such file, not TOML, or an unknown key or value.
        """
        try:
            return cls.model_validate(documents.from_toml(documents.content(path)))
        except OSError as error:
            raise EvaluationError(f"{path}: {error.strerror}") from error
        except documents.MalformedError as error:
            raise EvaluationError(f"{path}: not TOML: {error}") from error
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"]))
            raise EvaluationError(f"{path}: adapter {where}: {first['msg']}") from error

    def normalization(self, metadata: Mapping[str, str]) -> ImageNormalization:
        """Return the adapter's normalisation, or else the model's own.

        Raises:
            EvaluationError: Neither has one, or the metadata is malformed.
        """
        if self.image is not None:
            return self.image
        text = metadata.get(IMAGE)
        if text is None:
            raise EvaluationError(
                f"image normalisation unknown: the model has no metadata {IMAGE} and "
                f"the adapter no [image]"
            )
        try:
            return ImageNormalization.model_validate(documents.from_json(text))
        except (documents.MalformedError, ValidationError) as error:
            line = " ".join(str(error).split())
            raise EvaluationError(f"metadata {IMAGE} is malformed: {line}") from error

    def plan_of(
        self, metadata: Mapping[str, str], outputs: Sequence[str]
    ) -> PlanAdapter:
        """Return the adapter's reading of the plan, or else the model's own.

        Raises:
            EvaluationError: Nothing names the plan, or the model has no such output.
        """
        found = self.plan or PlanAdapter.of(metadata, outputs)
        there = ", ".join(outputs)
        if found is None:
            raise EvaluationError(
                f"the model has no output plan, and no adapter or metadata names one; "
                f"there are {there}"
            )
        if found.output not in outputs:
            raise EvaluationError(
                f"no output {found.output}, which the adapter names as the plan; there "
                f"are {there}"
            )
        if found.scores is not None and found.scores not in outputs:
            raise EvaluationError(
                f"no output {found.scores}, which the adapter names as the scores; "
                f"there are {there}"
            )
        return found

    def projection(self, lidar2img: Floats) -> Floats:
        """Turn [6, 4, 4] of the ego frame into that of the model's frame."""
        turn = np.eye(4)
        turn[:3, :3] = self.axes.to_ego
        return np.asarray(lidar2img @ turn, np.float32)

    def to_ego(self, waypoints: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Turn [6, 2] waypoints of the model's frame into the ego frame."""
        return np.asarray(waypoints @ self.axes.to_ego[:2, :2].T)
