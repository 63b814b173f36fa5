"""Checks of a model's inputs against the policy contract, before anything drives."""

from collections.abc import Mapping

import numpy as np

from me2e_compress.driving.contract import CAN_BUS_SIZE
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import DTYPES, SessionPort

Shape = tuple[int | str | None, ...]

CAMERAS = 6
CONTRACT: Mapping[str, Shape] = {
    "img": (CAMERAS, 3, None, None),
    "lidar2img": (CAMERAS, 4, 4),
    "can_bus": (CAN_BUS_SIZE,),
    "command": (),
    "timestamp": (),
}
"""Inputs of the contract without their batch dimension, which is one or open."""

DEFAULT_IMAGE_SIZE = (96, 160)
"""Rows and columns for a model that takes any size."""


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


def image_size(port: SessionPort) -> tuple[int, int]:
    """Return rows and columns of an image input that was checked."""
    found = port.shape[-2:]
    rows, columns = (side if isinstance(side, int) else None for side in found)
    return rows or DEFAULT_IMAGE_SIZE[0], columns or DEFAULT_IMAGE_SIZE[1]


def zeros(name: str, port: SessionPort) -> Array:
    """Return the first value of a recurrent input.

    Raises:
        EvaluationError: Its shape is open.
    """
    shape = tuple(side for side in port.shape if isinstance(side, int))
    if len(shape) != len(port.shape):
        raise EvaluationError(
            f"recurrent input {name} has shape {list(port.shape)}: an open shape has "
            "no first value"
        )
    return np.zeros(shape, DTYPES[port.type])


def fed(array: Array, port: SessionPort) -> Array:
    """Return an array with the number of dimensions and the type of a port."""
    missing = len(port.shape) - array.ndim
    sides = (1,) * missing + array.shape if missing >= 0 else array.shape[-missing:]
    return array.reshape(sides).astype(DTYPES[port.type], copy=False)


def fits(found: Shape, wanted: Shape) -> bool:
    """Return whether two shapes agree where both are known."""
    return len(found) == len(wanted) and all(
        not isinstance(side, int) or not isinstance(other, int) or side == other
        for side, other in zip(found, wanted, strict=True)
    )


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
