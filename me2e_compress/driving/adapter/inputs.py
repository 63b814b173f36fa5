"""An observation laid out as the inputs of a graph."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from me2e_compress.driving.adapter.adapter import Adapter
from me2e_compress.driving.adapter.images import ImageNormalization
from me2e_compress.driving.contract import CAN_BUS_SIZE, Observation
from me2e_compress.driving.ports import DEFAULT_IMAGE_SIZE, Shape, fed, fits, image_size
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import DTYPES, Session, SessionPort

CAMERAS = 6
CONTRACT: Mapping[str, Shape] = {
    "img": (CAMERAS, 3, None, None),
    "lidar2img": (CAMERAS, 4, 4),
    "can_bus": (CAN_BUS_SIZE,),
    "command": (),
    "timestamp": (),
}
"""Inputs of the contract without their batch dimension, which is one or open."""

MICROSECONDS = 1_000_000
"""In a second."""


@dataclass(frozen=True)
class ModelInputs:
    """How a graph is fed at each decision, recurrent inputs left out.

    Attributes:
        ports: Of the graph.
        adapter: How they relate to the contract.
        names: The graph's name for each input of the contract.
        normalization: Of the images; None without an image input.
        image_size: Rows and columns of the images.
    """

    ports: Mapping[str, SessionPort]
    adapter: Adapter
    names: Mapping[str, str]
    normalization: ImageNormalization | None
    image_size: tuple[int, int]

    @classmethod
    def of(
        cls, session: Session, adapter: Adapter, recurrent: Mapping[str, str]
    ) -> Self:
        """Check the inputs of a graph against the contract.

        Args:
            session: The graph.
            adapter: How its inputs relate to the contract.
            recurrent: Recurrent input to the output that answers it.

        Raises:
            EvaluationError: Naming the first port that is missing, unknown, or of a
                shape or type that cannot be fed.
        """
        names = {ours: ours for ours in CONTRACT} | {**adapter.inputs}
        check_inputs(session.inputs, session.outputs, names, recurrent)
        image = session.inputs.get(names["img"])
        found = None
        if image is not None:
            found = adapter.image or ImageNormalization.of(session.metadata)
        size = DEFAULT_IMAGE_SIZE if image is None else image_size(image)
        return cls(session.inputs, adapter, names, found, size)

    def feeds(self, observation: Observation) -> dict[str, Array]:
        """Lay an observation out as the graph takes it.

        Raises:
            EvaluationError: It needs images and there are none.
        """
        arrays: dict[str, Array] = {
            "lidar2img": self.adapter.projection(observation.lidar2img),
            "can_bus": observation.can_bus,
            "command": np.asarray(observation.command),
            "timestamp": np.asarray(observation.time_us / MICROSECONDS),
        }
        if self.normalization is not None:
            if observation.images is None:
                raise EvaluationError("the model needs images, and none were rendered")
            arrays["img"] = self.normalization.apply(observation.images)
        return {
            self.names[ours]: fed(array, self.ports[self.names[ours]])
            for ours, array in arrays.items()
            if self.names[ours] in self.ports
        }

    def nothing(self, command: int) -> Observation:
        """Return an observation of zeros, for a dry run."""
        return Observation(
            0,
            np.zeros((CAMERAS, *self.image_size, 3), np.uint8),
            np.tile(np.eye(4, dtype=np.float32), (CAMERAS, 1, 1)),
            np.zeros(CAN_BUS_SIZE, np.float32),
            command,
            0.0,
        )


def check_inputs(
    inputs: Mapping[str, SessionPort],
    outputs: Mapping[str, SessionPort],
    names: Mapping[str, str],
    recurrent: Mapping[str, str],
) -> None:
    """Check the inputs of a graph against the contract.

    Args:
        inputs: Of the graph.
        outputs: Of the graph.
        names: The graph's name for each input of the contract.
        recurrent: Recurrent input to the output that answers it.

    Raises:
        EvaluationError: Naming the first port that is missing, unknown, or of a shape
            or type that cannot be fed.
    """
    contract = {names[ours]: ours for ours in CONTRACT}
    for name in recurrent:
        _exists(name, inputs, "input")
        _exists(recurrent[name], outputs, "output")
    for ours, name in names.items():
        if name != ours:
            _exists(name, inputs, "input")
    for name, port in inputs.items():
        if port.type not in DTYPES:
            raise EvaluationError(f"input {name} is {port.type}: it cannot be fed")
        if name in recurrent:
            continue
        if name not in contract:
            raise EvaluationError(
                f"input {name} is none of {', '.join(CONTRACT)}, and no output is "
                "known to feed it"
            )
        _check_shape(name, port.shape, CONTRACT[contract[name]])


def _exists(name: str, ports: Mapping[str, SessionPort], kind: str) -> None:
    if name not in ports:
        raise EvaluationError(
            f"the adapter names {kind} {name}; there are {', '.join(ports)}"
        )


def _check_shape(name: str, found: Shape, wanted: Shape) -> None:
    batch = found[: max(0, len(found) - len(wanted))]
    if any(isinstance(side, int) and side != 1 for side in batch) or not fits(
        found[len(batch) :], wanted
    ):
        must = [1, *("any" if side is None else side for side in wanted)]
        raise EvaluationError(
            f"input {name} has shape {list(found)}, it must be {must}"
        )
