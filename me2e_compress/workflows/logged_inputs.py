"""How a stack of the zoo, or an ONNX file, is fed from recorded driving."""

from pathlib import Path

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.logs.log_frames import InputForm, LoggedInputs
from me2e_compress.calibration.pixels import PixelInput
from me2e_compress.driving.adapter import ImageNormalization
from me2e_compress.driving.adapter.image_inputs import Triple
from me2e_compress.errors import EvaluationError, FramesError
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.zoo.stacks import STACKS, Stack

STACK = "me2e.stack"
"""Metadata key: the stack of the zoo that a file was exported from."""
PICTURE_COLUMNS = 1600
"""Width of pictures of nuScenes and Bench2Drive, to which a stack's scale applies."""


def inputs_of_stack(stack: Stack) -> LoggedInputs:
    """Return how a stack of the zoo is fed from a log."""
    forms = {
        name: InputForm(shape, np.dtype(stack.dtypes.get(name, "float32")))
        for name, shape in stack.inputs.items()
        if name not in stack.recurrent
    }
    rows, columns = stack.inputs["img"][-2:]
    image = PixelInput(
        mean=stack.image.mean,
        std=stack.image.std,
        order=stack.image.order,
        rows=rows,
        columns=columns,
    )
    return LoggedInputs(forms, image, stack.trained, _picture_columns(stack, columns))


def inputs_of_model(path: Path, size: tuple[int, int] | None) -> LoggedInputs:
    """Return how an ONNX file, or a stack of several, is fed from a log.

    Files exported from UniAD or VAD see the ground in the axes of nuScenes' lidar, all
    others in those of the policy contract. `size` is rows and columns of the images,
    where the file leaves them open.

    Raises:
        FramesError: The image's metadata are malformed, or its size is open.
    """
    model = graph.load(path)
    fed_back = recurrent_inputs(model)
    forms = {
        str(each.name): _form(each, path)
        for each in model.graph.inputs
        if each.name not in fed_back
    }
    # the stack that a file was exported from decides the axes
    stack = STACKS.get(model.metadata_props.get(STACK, ""))
    forward_left = stack is None or stack.trained
    if "img" not in forms:
        return LoggedInputs(forms, None, forward_left)
    try:
        found = ImageNormalization.of(model.metadata_props)
    except EvaluationError as error:
        raise FramesError(f"{path}: {error}") from error
    # rows and columns of the file win over those given
    own = forms["img"].shape[-2:]
    rows, columns = (a or b for a, b in zip(own, size or (None, None), strict=True))
    if rows is None or columns is None:
        raise FramesError(
            f"{path}: img is {list(own)}, an open size: give it, as"
            " nuscenes{root=..., size=[384, 640]}"
        )
    image = PixelInput(
        mean=_unscaled(found.mean, found.scale),
        std=_unscaled(found.std, found.scale),
        order=found.order,
        rows=rows,
        columns=columns,
    )
    return LoggedInputs(forms, image, forward_left, _picture_columns(stack, columns))


def _picture_columns(stack: Stack | None, columns: int) -> int | None:
    """Return the columns that a picture takes: of 416, UniAD of DL4AGX fills 400."""
    if stack is None or stack.trained or columns != stack.inputs["img"][-1]:
        return None
    return round(PICTURE_COLUMNS * stack.scale)


def _unscaled(levels: Triple, scale: float) -> Triple:
    """Return grey levels of whole pixels: (s * p - m) / d is (p - m / s) / (d / s)."""
    red, green, blue = levels
    return red / scale, green / scale, blue / scale


def _form(value: ir.Value, path: Path) -> InputForm:
    if value.shape is None or value.dtype is None:
        raise FramesError(f"{path}: input {value.name} has no type or rank")
    sides = tuple(side if isinstance(side, int) else None for side in value.shape)
    return InputForm(sides, value.dtype.numpy())
