"""Sample images and volumes at positions (torch's ``grid_sample``), and map levels."""

import dataclasses
import functools
import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import array_of
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
from me2e_compress.operators.kernels.kernel import DOMAIN

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


GRID_SAMPLE_OPSET = 16  # the first opset of ONNX's GridSample

Numbers = npt.NDArray[np.float64]
Sizes = npt.NDArray[np.integer]


def sample_levels(
    call: FusedCall,
    value: ir.Value,
    sizes: ir.Value,
    starts: ir.Value,
    locations: ir.Value,
    weights: ir.Value,
) -> ir.Value:
    """Write the weighted sum of samples of several maps, [N, Q, M, D].

    A position 0..1 of a map of W columns is column position * W - 0.5; outside of the
    map is zero (``grid_sample`` with ``align_corners=False``, zeros). The result has
    the element type of ``value``. Written as a kernel's call, with GridSample where the
    sizes of the maps are constants, or with Gather for any opset.

    Args:
        call: where to write.
        value: [N, S, M, D], the maps concatenated.
        sizes: [L, 2], height and width of each map.
        starts: [L], the first of the S rows of each map.
        locations: [N, Q, M, L, P, 2], x and y in 0..1; [N, Q, 1, L, P, 2] where all
            heads sample the same positions.
        weights: [N, Q, M, L, P].
    """
    kind = value.dtype
    if kind == ir.DataType.FLOAT16:  # onnxruntime's CPU has no kernels for it
        value, locations, weights = (
            call.cast(each, ir.DataType.FLOAT) for each in (value, locations, weights)
        )
    # Prefer a kernel, then GridSample, then Gather
    known, first = array_of(sizes), array_of(starts)
    if call.compiled and value.dtype in (None, ir.DataType.FLOAT):
        inputs = (value, sizes, starts, locations, weights)
        result = call.add("MultiScaleDeformableAttention", inputs, domain=DOMAIN)
        outer = [call.known_size(weights, axis) for axis in range(3)]
        result.shape = ir.Shape([*outer, call.known_size(value, 3)])
        result.type = ir.TensorType(ir.DataType.FLOAT)
    elif known is None or first is None or call.opset < GRID_SAMPLE_OPSET:
        result = _by_gather(call, value, sizes, starts, locations, weights)
    else:
        maps = np.column_stack((known, first)).tolist()
        result = _by_grid_sample(call, value, maps, locations, weights)
    return call.cast(result, kind) if kind is not None else result


def _by_grid_sample(
    call: FusedCall,
    value: ir.Value,
    maps: Sequence[tuple[int, int, int]],
    locations: ir.Value,
    weights: ir.Value,
) -> ir.Value:
    """Sample with GridSample; ``maps`` are the height, width and first row of each."""
    # One image per head, or all heads as channels if they share
    batch, heads, width = (call.size(value, axis) for axis in (0, 2, 3))
    queries, points = call.size(locations, 1), call.size(locations, 4)
    both = call.product(batch, heads)
    shared = call.size(locations, 2) == 1
    images, channels = (batch, call.product(heads, width)) if shared else (both, width)
    # GridSample takes positions in -1..1
    scaled = call.add("Mul", [locations, call.numbers(2.0, locations)])
    grids = call.add("Sub", [scaled, call.numbers(1.0, locations)])
    grids = call.transpose(grids, (0, 2, 3, 1, 4, 5))  # [N, M, L, Q, P, 2]
    by_head = call.transpose(value, (0, 2, 3, 1))  # [N, M, D, S]
    samples, sampled = [], []
    for level, (height, columns, start) in enumerate(maps):
        if not height * columns:
            continue
        rows = call.slice(by_head, start, start + height * columns, 3)
        image = call.reshape(rows, (images, channels, height, columns))
        grid = call.slice(grids, level, level + 1, 2)
        grid = call.reshape(grid, (images, queries, points, 2))
        sample = call.add("GridSample", [image, grid], {"align_corners": 0})
        if shared:
            sample = call.reshape(sample, (both, width, queries, points))
        samples.append(sample)  # [N*M, D, Q, P]
        sampled.append(level)
    if not samples:
        return call.full((batch, queries, heads, width), 0.0, value)
    # Multiply by the weights and sum over levels and points
    weights = call.transpose(weights, (0, 2, 1, 3, 4))  # [N, M, Q, L, P]
    if len(sampled) < len(maps):
        weights = call.add("Gather", [weights, call.integers(sampled)], {"axis": 3})
    flat = call.product(len(sampled), points)
    weights = call.reshape(weights, (both, 1, queries, flat))
    weighted = call.add("Mul", [call.concat(samples, 3), weights])  # [.., D, Q, L*P]
    summed = call.reshape(call.sum(weighted, (3,)), (batch, heads, width, queries))
    return call.transpose(summed, (0, 3, 1, 2))


def _by_gather(
    call: FusedCall,
    value: ir.Value,
    sizes: ir.Value,
    starts: ir.Value,
    locations: ir.Value,
    weights: ir.Value,
) -> ir.Value:
    """Gather the four rows around each position; a row of zeros stands for outside."""
    # Pixels around each position, along both axes
    heads, width = call.size(value, 2), call.size(value, 3)
    sizes = call.cast(sizes, ir.DataType.INT64)
    height, columns = (
        call.unsqueeze(
            call.add("Gather", [sizes, call.integers(axis)], {"axis": 1}), (1,)
        )
        for axis in (0, 1)
    )
    x, y = call.split_last(locations, 2)
    axes = [_corner_pixels(call, *axis) for axis in ((x, columns), (y, height))]
    # Row 0 is the row of zeros
    padded = call.add("Pad", [value, call.integers([0, 1, 0, 0, 0, 0, 0, 0])])
    rows = call.reshape(padded, (-1, width))
    # The first row of image n, head m, level l: (n (S + 1) + start + 1) M + m
    batch, length, outer = (call.size(padded, axis) for axis in (0, 1, 2))
    many = call.value_of(outer)
    starts = call.cast(starts, ir.DataType.INT64)
    level = call.add("Mul", [call.add("Add", [starts, call.integers([1])]), many])
    level = call.unsqueeze(level, (1,))
    head = call.unsqueeze(call.counting(outer), (1, 2))
    base = call.add("Add", [head, level])  # [M, L, 1]
    if batch != 1:
        step = call.value_of(call.product(length, outer))
        image = call.add("Mul", [call.counting(batch), step])
        base = call.add("Add", [call.unsqueeze(image, (1, 2, 3, 4)), base])
    many = call.value_of(heads)
    nothing, zero = call.integers(0), call.numbers(0.0, weights)
    parts = []
    # Add the four corners, each in row base + (y W + x) M
    for row, row_inside, row_part in axes[1]:
        for column, inside, part in axes[0]:
            where = call.add("And", [inside, row_inside])  # [N, Q, M, L, P]
            at = call.add("Add", [call.add("Mul", [row, columns]), column])
            index = call.add("Add", [base, call.add("Mul", [at, many])])
            index = call.add("Where", [where, index, nothing])
            # Bilinear share times weight; 0 outside
            share = call.add("Mul", [call.add("Mul", [part, row_part]), weights])
            share = call.add("Where", [where, share, zero])
            corner = call.add("Gather", [rows, index], {"axis": 0})
            corner = call.add("Mul", [corner, call.unsqueeze(share, (5,))])
            parts.append(call.sum(corner, (3, 4)))  # [N, Q, M, D]
    return functools.reduce(lambda one, two: call.add("Add", [one, two]), parts)


def _corner_pixels(
    call: FusedCall, position: ir.Value, count: ir.Value
) -> list[tuple[ir.Value, ir.Value, ir.Value]]:
    """Write index, inside and share of the two pixels around a position on one axis."""
    size = call.cast(count, position.dtype or ir.DataType.FLOAT)
    # The pixel below the position, and the distance to it
    scaled = call.add("Mul", [position, size])
    pixel = call.add("Sub", [scaled, call.numbers(0.5, position)])
    low = call.add("Floor", [pixel])
    part = call.add("Sub", [pixel, low])
    one = call.numbers(1.0, pixel)
    neighbours = []
    for edge, share in (
        (low, call.add("Sub", [one, part])),
        (call.add("Add", [low, one]), part),
    ):
        # A neighbour outside of the map counts as zero
        above = call.add("GreaterOrEqual", [edge, call.numbers(0.0, pixel)])
        inside = call.add("And", [above, call.add("Less", [edge, size])])
        neighbours.append((call.cast(edge, ir.DataType.INT64), inside, share))
    return neighbours


def sample_levels_array(
    value: Numbers, sizes: Sizes, starts: Sizes, locations: Numbers, weights: Numbers
) -> Numbers:
    """Compute :func:`sample_levels` in numpy; infinite positions are outside."""
    batch, _, heads, width = value.shape
    total = np.zeros((batch, locations.shape[1], heads, width))
    locations = np.where(np.isfinite(locations), locations, -1.0)
    for level, ((height, columns), start) in enumerate(zip(sizes, starts, strict=True)):
        if not height * columns:
            continue
        # One image per head, positions in -1..1
        rows = value[:, start : start + height * columns]  # [N, H*W, M, D]
        image = rows.transpose(0, 2, 3, 1).reshape(-1, width, height, columns)
        grid = 2 * locations[:, :, :, level].transpose(0, 2, 1, 3, 4) - 1
        grid = np.broadcast_to(grid, (batch, heads, *grid.shape[2:]))  # [N, M, Q, P, 2]
        flat = grid.reshape(-1, *grid.shape[2:])
        samples = grid_sample_array((image, flat), BILINEAR)  # [N*M, D, Q, P]
        samples = samples.reshape(batch, heads, width, *grid.shape[2:4])
        total += np.einsum("nmdqp,nqmp->nqmd", samples, weights[:, :, :, level])
    return total
