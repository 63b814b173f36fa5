"""The TOML file that adapts a model."""

from pathlib import Path
from typing import Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, ValidationError

from me2e_compress import documents
from me2e_compress.driving.adapter.axes import Axes
from me2e_compress.driving.adapter.images import ImageNormalization
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.plan_adapter import PlanAdapter

Floats: TypeAlias = npt.NDArray[np.float32]
Contract: TypeAlias = Literal["img", "lidar2img", "can_bus", "command", "timestamp"]


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

    def projection(self, lidar2img: Floats) -> Floats:
        """Turn [6, 4, 4] of the ego frame into that of the model's frame."""
        turn = np.eye(4)
        turn[:3, :3] = self.axes.to_ego
        return np.asarray(lidar2img @ turn, np.float32)

    def to_ego(self, waypoints: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Turn [n, 2] waypoints of the model's frame into the ego frame."""
        return np.asarray(waypoints @ self.axes.to_ego[:2, :2].T)
