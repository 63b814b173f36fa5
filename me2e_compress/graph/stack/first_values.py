"""Read first values of recurrent inputs from files."""

from pathlib import Path

import numpy as np

from me2e_compress.display import reason
from me2e_compress.errors import GraphError
from me2e_compress.graph.nodes import Array
from me2e_compress.graph.recurrence import SessionPort
from me2e_compress.graph.stack.part_graph import form, misfit
from me2e_compress.registry.documents import UNREADABLE, check_regular


def read_value(path: Path, name: str, where: str) -> Array:
    """Read a first value; from an ``.npz``, the array named like the input.

    ``where`` begins the message of the GraphError for a file that cannot be read.
    """
    try:
        check_regular(path)
        held = np.load(path, allow_pickle=False)
        if isinstance(held, np.ndarray):
            return np.asarray(held)
        with held:
            return np.asarray(held[name])
    except KeyError as error:
        raise GraphError(f"{where} holds no array {name}") from error
    except UNREADABLE as error:
        raise GraphError(f"{where} cannot be read: {reason(error)}") from error


def fitted(value: Array, port: SessionPort, where: str) -> Array:
    """Prepend dimensions of 1 to an array, and check it against its input."""
    missing = max(0, len(port.shape) - value.ndim)
    value = value.reshape((1,) * missing + value.shape)
    element = {"float32": "float", "float64": "double"}.get(
        value.dtype.name, value.dtype.name
    )
    found = SessionPort(f"tensor({element})", value.shape)
    if misfit(found, port):
        raise GraphError(
            f"{where} is {form(found)}, and the input takes {form(port)}: of another"
            " stack?"
        )
    return value
