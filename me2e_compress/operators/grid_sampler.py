"""Sample an image or a volume at a grid of positions (torch's ``grid_sample``)."""

import dataclasses
import itertools

import numpy as np
import onnx_ir as ir

from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    FLOAT32,
    FLOATS,
    INT8_TOO,
    OWN_DOMAIN,
    Arrays,
    Attribute,
    Dialect,
    NdArray,
    Operand,
    Shapes,
    Values,
    number,
    present,
)

_BILINEAR, _NEAREST, _BICUBIC = range(3)
_ZEROS, _BORDER, _REFLECTION = range(3)
# Attributes of zeros outside, where -1 and 1 are the outer edges
BILINEAR = {"interpolation_mode": _BILINEAR, "padding_mode": _ZEROS, "align_corners": 0}

# The parameter of torch's and ONNX's cubic convolution (Keys 1981 has -0.5)
_CUBIC = -0.75


def grid_sample_array(inputs: Arrays, attributes: Attributes) -> NdArray:
    """Compute ``grid_sample`` in numpy, [N, C, ...] float64."""
    image, grid = (np.asarray(value, np.float64) for value in inputs)
    batch, channels, *sizes = image.shape
    rows = image.reshape(batch, channels, -1)
    # Neighbours along each axis
    axes = [
        _neighbours(grid[..., axis], size, attributes)
        for axis, size in enumerate(reversed(sizes))
    ]
    total = np.zeros((batch, channels, *grid.shape[1:-1]))
    first = np.arange(batch).reshape(batch, *(1 for _ in sizes))
    # Add all combinations of neighbours
    for near in itertools.product(*axes):
        index = np.zeros(grid.shape[:-1], np.int64)
        share, step = np.ones(grid.shape[:-1]), 1
        for (along, part), size in zip(near, reversed(sizes), strict=True):
            index, share, step = index + along * step, share * part, step * size
        values = rows[first, :, index]  # [N, ..., C]
        total += np.moveaxis(values * share[..., None], -1, 1)
    return total


def _neighbours(
    at: NdArray, size: int, options: Attributes
) -> list[tuple[NdArray, NdArray]]:
    """Return the pixels around positions on one axis, and their shares."""
    aligned, mode = bool(options["align_corners"]), options["interpolation_mode"]
    # Position in pixels, padded unless bicubic
    pixel = (at + 1) / 2 * (size - 1) if aligned else ((at + 1) * size - 1) / 2
    if mode != _BICUBIC:
        pixel = _padded(pixel, size, options)
    low = np.floor(pixel)
    part = pixel - low
    # Neighbours and their shares
    if mode == _NEAREST:
        around = [(np.round(pixel), np.ones_like(pixel))]
    elif mode == _BILINEAR:
        around = [(low, 1 - part), (low + 1, part)]
    else:
        around = [(low + step, _cubic(np.abs(part - step))) for step in (-1, 0, 1, 2)]
    # Neighbours of bicubic samples are padded one by one
    result = []
    for place, share in around:
        edge = _padded(place, size, options) if mode == _BICUBIC else place
        inner = edge.clip(0, size - 1)  # what is outside has no share
        result.append((inner.astype(np.int64), np.where(inner == edge, share, 0)))
    return result


def _cubic(distance: NdArray) -> NdArray:
    """Return the weights of cubic convolution at distances of up to 1, and 1 to 2."""
    near = ((_CUBIC + 2) * distance - (_CUBIC + 3)) * distance**2 + 1
    far = _CUBIC * (((distance - 5) * distance + 8) * distance - 4)
    return np.where(distance <= 1, near, far)


def _padded(pixel: NdArray, size: int, options: Attributes) -> NdArray:
    """Move positions in pixels into the image, as the padding mode does."""
    padding, aligned = options["padding_mode"], bool(options["align_corners"])
    if padding == _REFLECTION:
        low, span = (0.0, size - 1) if aligned else (-0.5, size)
        if span == 0:
            return np.zeros_like(pixel)
        # Distance from the low edge, folded at both edges
        off = np.abs(pixel - low) % (2 * span)
        pixel = np.minimum(off, 2 * span - off) + low
    return pixel if padding == _ZEROS else pixel.clip(0, size - 1)


_SCALE = 10.0  # BEVFormer_tensorrt multiplies a grid by this for a better int8 range


def _options(first: str, *, required: bool = True) -> tuple[Attribute, ...]:
    return (
        Attribute(first, 0, required, (0, 1, 2), own="interpolation_mode"),
        Attribute("padding_mode", 0, required, (0, 1, 2)),
        Attribute("align_corners", 0, required, (0, 1)),
    )


_OWN = _options("interpolation_mode")


@dataclasses.dataclass(frozen=True)
class ScaledGrid(Dialect):
    """A library whose grid is [N, 2 or 3, ...] and multiplied by 10."""

    def inputs_to_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Put the components last, in -1..1."""
        image, grid = present(inputs)
        rank = self.operands[1].rank or 4
        grid = call.transpose(grid, (0, *range(2, rank), 1))
        return image, call.add("Div", [grid, call.numbers(_SCALE, grid)])

    def inputs_from_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Put the components first, in -10..10."""
        image, grid = present(inputs)
        rank = self.operands[1].rank or 4
        grid = call.transpose(grid, (0, rank - 1, *range(1, rank - 1)))
        return image, call.add("Mul", [grid, call.numbers(_SCALE, grid)])

    def shapes_to_own(self, shapes: Shapes) -> Shapes:
        """Put the components last."""
        image, grid = shapes
        return image, None if grid is None else (grid[0], *grid[2:], grid[1])


def _operands(
    dims: int, types: tuple[ir.DataType, ...], *, first: bool = False
) -> tuple[Operand, ...]:
    image, grid = ("H W", "F G") if dims == 2 else ("D H W", "E F G")
    spelt = f"N {dims} {grid}" if first else f"N {grid} {dims}"
    return (
        Operand("input", f"N C {image}", types),
        Operand("grid", spelt, types, positions=True),
    )


def _own(dims: int) -> Dialect:
    return Dialect(
        "me2e", f"GridSampler{dims}D", OWN_DOMAIN, _operands(dims, FLOATS), "me2e", _OWN
    )


def _scaled(dims: int) -> tuple[Dialect, ...]:
    op_type, types = f"GridSampler{dims}DTRT", INT8_TOO if dims == 2 else FLOATS
    operands = _operands(dims, types, first=True)
    source = "BEVFormer_tensorrt"
    return (
        ScaledGrid("derryhub", op_type, "", operands, source, _OWN),
        ScaledGrid("derryhub-trt2", f"{op_type}2", "", operands, source, _OWN),
        ScaledGrid(
            "dl4agx", "GridSamplePlugin", "custom_op",
            _operands(dims, FLOATS, first=True), "DL4AGX",
            _options("mode", required=False),
        ),
    )  # fmt: skip


_MMDEPLOY = _operands(2, FLOAT32)


@dataclasses.dataclass(frozen=True)
class GridSampler2D(Operator):
    """Sample an image at a grid of positions.

    Own form ``me2e::GridSampler2D``: input [N, C, H, W]; grid [N, F, G, 2] (x, y),
    where -1 and 1 are the edges; ``interpolation_mode`` 0 bilinear, 1 nearest, 2
    bicubic; ``padding_mode`` 0 zeros, 1 border, 2 reflection; ``align_corners``. Output
    [N, C, F, G].
    """

    name = "grid-sampler-2d"
    output = "N C F G"
    work = "N C F G"
    own = _own(2)
    dialects = (
        *_scaled(2),
        Dialect("mmdeploy", "grid_sampler", "mmdeploy", _MMDEPLOY, "mmdeploy", _OWN),
    )
    opset = 16

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write GridSample, which onnxruntime's CPU has for float32 in every opset."""
        image, grid = present(inputs)
        kind = image.dtype or ir.DataType.FLOAT
        if kind != ir.DataType.FLOAT:
            image, grid = (call.cast(each, ir.DataType.FLOAT) for each in (image, grid))
        modes = _NEW_MODES if call.opset >= _RENAMED else _MODES
        options: dict[str, str | int] = {
            "mode": modes[number(attributes, "interpolation_mode")],
            "padding_mode": _PADDING[number(attributes, "padding_mode")],
            "align_corners": number(attributes, "align_corners"),
        }
        return call.cast(call.add("GridSample", [image, grid], options), kind)

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [N, C, ...] float64."""
        return grid_sample_array(inputs, attributes)

    def macs(self, shapes: Shapes, attributes: Attributes) -> int | None:
        """Count the neighbours of each element: 2 or 4 along each axis, or none."""
        mode = number(attributes, "interpolation_mode")
        elements, axes = super().macs(shapes, attributes), len(self.output.split()) - 2
        # Nearest samples only move data
        factor = {_BILINEAR: 2**axes, _NEAREST: 0, _BICUBIC: 4**axes}[mode]
        return None if elements is None else elements * int(factor)


_MODES, _NEW_MODES = ("bilinear", "nearest", "bicubic"), ("linear", "nearest", "cubic")
# The opset from which GridSample's modes have other names and volumes are allowed
_RENAMED = 20
_PADDING = ("zeros", "border", "reflection")


@dataclasses.dataclass(frozen=True)
class GridSampler3D(GridSampler2D):
    """Sample a volume at a grid of positions.

    Own form ``me2e::GridSampler3D``: input [N, C, D, H, W]; grid [N, E, F, G, 3]
    (x, y, z); attributes as in :class:`GridSampler2D`, but no bicubic. Output
    [N, C, E, F, G].
    """

    name = "grid-sampler-3d"
    output = "N C E F G"
    work = "N C E F G"
    own = _own(3)
    dialects = _scaled(3)
    opset = _RENAMED
