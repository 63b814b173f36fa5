"""How an ONNX file is fed from recorded driving."""

from pathlib import Path

import onnx_ir as ir

from driving_logs.model_inputs import InputForm, LoggedInputs
from me2e_compress import graph
from me2e_compress.base.errors import EvaluationError, FramesError
from me2e_compress.calibration.dataset import PixelInput
from me2e_compress.driving.adapter import ImageNormalization
from me2e_compress.driving.adapter.image_inputs import Triple
from me2e_compress.graph.recurrence import recurrent_inputs

STACK = "me2e.stack"
"""Metadata key: the stack that a file was exported from."""
LIDAR_STACKS = ("vad-tiny", "uniad-tiny", "uniad-trt")
"""Stacks that see the ground in the axes of nuScenes' lidar."""
PICTURE_OF = {416: 400}
"""Columns that a picture takes of those of an image, where it does not take all: UniAD
of DL4AGX."""


def inputs_of_model(path: Path, size: tuple[int, int] | None) -> LoggedInputs:
    """Return how an ONNX file is fed from a log.

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
    stack = model.metadata_props.get(STACK, "")
    forward_left = stack not in LIDAR_STACKS
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
    width = None if forward_left else PICTURE_OF.get(columns)
    return LoggedInputs(forms, image, forward_left, width)


def _unscaled(levels: Triple, scale: float) -> Triple:
    """Return grey levels of whole pixels: (s * p - m) / d is (p - m / s) / (d / s)."""
    red, green, blue = levels
    return red / scale, green / scale, blue / scale


def _form(value: ir.Value, path: Path) -> InputForm:
    if value.shape is None or value.dtype is None:
        raise FramesError(f"{path}: input {value.name} has no type or rank")
    sides = tuple(side if isinstance(side, int) else None for side in value.shape)
    return InputForm(sides, value.dtype.numpy())
