"""The ports of a graph: fit of shapes, and conversion of arrays."""

import numpy as np

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import DTYPES, SessionPort

Shape = tuple[int | str | None, ...]

DEFAULT_IMAGE_SIZE = (96, 160)
"""Rows and columns for a model that takes any size."""


def zeros(name: str, port: SessionPort) -> Array:
    """Return the first value of a recurrent input."""
    shape = tuple(side for side in port.shape if isinstance(side, int))
    if len(shape) != len(port.shape):
        raise EvaluationError(
            f"recurrent input {name} has shape {list(port.shape)}: an open shape has "
            "no first value"
        )
    return np.zeros(shape, DTYPES[port.type])


def fed(array: Array, port: SessionPort) -> Array:
    """Return an array with the rank and type of a port."""
    missing = len(port.shape) - array.ndim
    sides = (1,) * missing + array.shape if missing >= 0 else array.shape[-missing:]
    return array.reshape(sides).astype(DTYPES[port.type], copy=False)


def fits(found: Shape, wanted: Shape) -> bool:
    """Return whether two shapes agree where both are known."""
    return len(found) == len(wanted) and all(
        not isinstance(side, int) or not isinstance(other, int) or side == other
        for side, other in zip(found, wanted, strict=True)
    )
