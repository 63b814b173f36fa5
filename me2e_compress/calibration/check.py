"""Hold one frame against what a model takes."""

import numpy as np
import onnx_ir as ir

from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.recurrence import recurrent_inputs


def check_frame(frame: Frame, model: ir.Model, source: str) -> None:
    """Check names, dtypes, shapes and that every number is one.

    Args:
        frame: what was recorded.
        model: whose inputs it must fit; recurrent inputs may be absent.
        source: what the message calls the frame, e.g. its file.

    Raises:
        FramesError: names the frame and the input, what was found, what is expected.
    """
    ports = {str(value.name): value for value in model.graph.inputs}
    optional = recurrent_inputs(model)
    for name, value in ports.items():
        array = frame.arrays.get(name)
        if array is not None:
            _check(array, value, f"{source}: {name}")
        elif name not in optional:
            raise FramesError(
                f"{source}: {name} is missing; there is {', '.join(frame.arrays)}"
            )
    if unknown := [name for name in frame.arrays if name not in ports]:
        raise FramesError(
            f"{source}: {unknown[0]} is no input; the model takes {', '.join(ports)}"
        )


def _check(array: Array, value: ir.Value, where: str) -> None:
    if value.dtype is not None and array.dtype != value.dtype.numpy():
        raise FramesError(f"{where} is {array.dtype}, expected {value.dtype.numpy()}")
    if value.shape is not None and not _fits(array.shape, value.shape):
        raise FramesError(
            f"{where} has shape {list(array.shape)}, expected {value.shape}"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        kind = "NaN" if np.isnan(array).any() else "infinite"
        at = np.argwhere(~np.isfinite(array))[0].tolist()
        raise FramesError(f"{where} is {kind} at {at}, expected finite numbers")


def _fits(found: tuple[int, ...], expected: ir.Shape) -> bool:
    return len(found) == len(expected) and all(
        not isinstance(want, int) or have == want
        for have, want in zip(found, expected, strict=True)
    )
