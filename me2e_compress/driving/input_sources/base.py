"""What an input source is."""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.axes import Axes
from me2e_compress.driving.contract import Observation
from me2e_compress.driving.ego_kinematics import EgoKinematics
from me2e_compress.driving.ego_track import EgoTrack
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array


@dataclass(frozen=True, eq=False, slots=True)
class Observed:
    """What a source may look at.

    Attributes:
        observation: Of this decision.
        axes: Ground frame of the model.
        track: Where the ego has been on this route, this decision included.
        projections: Ego frame to pixels of each image input as the model sees it, by
            the input's name, float32 [cameras, 4, 4]; without image inputs, under the
            empty name, to those of the six cameras.
    """

    observation: Observation
    axes: Axes
    track: EgoTrack
    projections: Mapping[str, npt.NDArray[np.float32]]

    @property
    def motion(self) -> EgoKinematics:
        """Where the ego is and how it moves.

        Raises:
            EvaluationError: The observation does not say.
        """
        if self.observation.motion is None:
            raise EvaluationError(
                "the adapter asks where the ego is, and the observation does not say"
            )
        return self.observation.motion

    def turned(self, vectors: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Turn [..., 2] of the ego frame into the model's."""
        return np.asarray(vectors, np.float64) @ self.axes.to_ego[:2, :2]

    def angle(self, counter_clockwise: float) -> float:
        """Return an angle, or a rate of one, as the model's axes count it."""
        return -counter_clockwise if self.axes.is_left_handed else counter_clockwise


@dataclass(frozen=True)
class InputSource(abc.ABC):
    """Says one thing of a decision in numbers; its fields are its options.

    Class attributes:
        name: What adapters call it.
    """

    name: ClassVar[str]

    @abc.abstractmethod
    def value(self, seen: Observed) -> Array:
        """Return it, always of the same shape and type, without a batch dimension.

        Raises:
            EvaluationError: The observation does not tell it.
        """
