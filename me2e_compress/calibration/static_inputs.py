"""Inputs that became constants of a graph, but may still be in its frames.

``static-geometry`` builds a graph for one vehicle's camera matrices. A recording of
that vehicle still fits it; one of another vehicle does not, and only this check tells.
"""

import hashlib
import json
from collections.abc import Mapping

import onnx_ir as ir

from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Array

STATIC_INPUTS = "me2e.static_inputs"
"""Metadata key of a graph: JSON with a digest of every input that became constant."""


def static_inputs(model: ir.Model) -> dict[str, str]:
    """Read the digests of inputs that became constants."""
    try:
        found = json.loads(model.metadata_props.get(STATIC_INPUTS, "{}"))
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def enter_static(model: ir.Model, arrays: Mapping[str, Array]) -> None:
    """Record that inputs are now constants."""
    known = static_inputs(model)
    known |= {name: digest_of(array) for name, array in arrays.items()}
    model.metadata_props[STATIC_INPUTS] = json.dumps(known, sort_keys=True)


def check_static(name: str, array: Array, digest: str, where: str) -> None:
    """Raise a FramesError if a frame's array differs from the graph's constant."""
    if digest_of(array) != digest:
        raise FramesError(
            f"{where}: {name} is not the one that the graph was made for"
            " (static-geometry)"
        )


def digest_of(array: Array) -> str:
    """Return a digest of an array's type, shape and content."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(repr((array.dtype.str, array.shape)).encode())
    digest.update(array.tobytes())
    return digest.hexdigest()
