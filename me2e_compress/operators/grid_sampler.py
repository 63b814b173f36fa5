"""Sample an image or a volume at a grid of positions (torch's ``grid_sample``)."""

import dataclasses
import math
from collections.abc import Sequence
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph.shapes import Dims
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
    Values,
    number,
    present,
)
from me2e_compress.operators.grid_positions import grid_by_gather, grid_sample_array
from me2e_compress.operators.renamed_attributes import RenamedAttributes

_SCALE = 10.0
"""BEVFormer_tensorrt multiplies a grid by this for a better int8 range."""


def _options(first: str, *, required: bool = True) -> tuple[Attribute, ...]:
    return (
        Attribute(first, 0, required, (0, 1, 2)),
        Attribute("padding_mode", 0, required, (0, 1, 2)),
        Attribute("align_corners", 0, required, (0, 1)),
    )


_OWN = _options("interpolation_mode")


@dataclasses.dataclass(frozen=True)
class Sampler(RenamedAttributes):
    """A library with its own names for the three attributes, in the same order."""

    own_attributes: ClassVar[tuple[Attribute, ...]] = _OWN


@dataclasses.dataclass(frozen=True)
class ScaledGrid(Sampler):
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

    def arrays_to_own(self, arrays: Arrays, attributes: Attributes) -> Arrays:
        """Put the components last, in -1..1."""
        image, grid = arrays
        assert grid is not None
        return image, grid.transpose(0, *range(2, grid.ndim), 1) / _SCALE

    def shapes_to_own(self, shapes: Sequence[Dims | None]) -> Sequence[Dims | None]:
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
    return Sampler(
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
            "dl4agx",
            "GridSamplePlugin",
            "custom_op",
            _operands(dims, FLOATS, first=True),
            "DL4AGX",
            _options("mode", required=False),
        ),
    )


@dataclasses.dataclass(frozen=True)
class GridSampler2D(Operator):
    """Sample an image at a grid of positions.

    Own form ``me2e::GridSampler2D``: input [N, C, H, W]; grid [N, F, G, 2] (x, y),
    where -1 and 1 are the edges; ``interpolation_mode`` 0 bilinear, 1 nearest, 2
    bicubic; ``padding_mode`` 0 zeros, 1 border, 2 reflection; ``align_corners``. Output
    [N, C, F, G].
    """

    name: ClassVar[str] = "grid-sampler-2d"
    own: ClassVar[Dialect] = _own(2)
    dialects: ClassVar[tuple[Dialect, ...]] = (
        *_scaled(2),
        Sampler(
            "mmdeploy",
            "grid_sampler",
            "mmdeploy",
            _operands(2, FLOAT32),
            "mmdeploy",
            _OWN,
        ),
    )
    native_opset: ClassVar[int] = 16

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write GridSample, or below its opset a Gather, which cannot be bicubic."""
        image, grid = present(inputs)
        kind = image.dtype or ir.DataType.FLOAT
        if kind == ir.DataType.FLOAT16:  # onnxruntime's CPU has no kernel for it
            image, grid = (call.cast(each, ir.DataType.FLOAT) for each in (image, grid))
        if call.opset < self.native_opset:
            result = grid_by_gather(call, image, grid, attributes)
        else:
            modes = _NEW_MODES if call.opset >= _RENAMED else _MODES
            options: dict[str, str | int] = {
                "mode": modes[number(attributes, "interpolation_mode")],
                "padding_mode": _PADDING[number(attributes, "padding_mode")],
                "align_corners": number(attributes, "align_corners"),
            }
            result = call.add("GridSample", [image, grid], options)
        return call.cast(result, kind)

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [N, C, ...] float64."""
        return grid_sample_array(inputs, attributes)

    def output_shape(
        self, shapes: Sequence[Dims | None], attributes: Attributes
    ) -> Dims | None:
        """Return batch and channels of the input, then the sizes of the grid."""
        image, grid = shapes
        if grid is None:
            return None
        return (*((None, None) if image is None else image[:2]), *grid[1:-1])

    def macs(self, shapes: Sequence[Dims | None], attributes: Attributes) -> int | None:
        """Count the neighbours of each element: 2, 1 or 4 along each axis."""
        shape = self.output_shape(shapes, attributes)
        known = [dim for dim in shape or () if dim is not None]
        if shape is None or len(known) < len(shape):
            return None
        # Nearest moves data only
        mode = number(attributes, "interpolation_mode")
        if mode == 1:
            return 0
        each: int = (4 if mode == 2 else 2) ** (len(known) - 2)
        return math.prod(known) * each


_MODES, _NEW_MODES = ("bilinear", "nearest", "bicubic"), ("linear", "nearest", "cubic")
_RENAMED = 20
"""The opset from which GridSample's modes have other names and volumes are allowed."""
_PADDING = ("zeros", "border", "reflection")


@dataclasses.dataclass(frozen=True)
class GridSampler3D(GridSampler2D):
    """Sample a volume at a grid of positions.

    Own form ``me2e::GridSampler3D``: input [N, C, D, H, W]; grid [N, E, F, G, 3]
    (x, y, z); attributes as in :class:`GridSampler2D`, but no bicubic. Output
    [N, C, E, F, G].
    """

    name: ClassVar[str] = "grid-sampler-3d"
    own: ClassVar[Dialect] = _own(3)
    dialects: ClassVar[tuple[Dialect, ...]] = _scaled(3)
    native_opset: ClassVar[int] = _RENAMED
