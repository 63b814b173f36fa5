"""Bilinear samples of feature maps that are concatenated in one tensor.

A position 0..1 of a map of W columns is column position * W - 0.5; outside of the map
is zero (``grid_sample`` with ``align_corners=False``, zeros). Written with GridSample
where the sizes of the maps are constants, with Gather for any opset, as a compiled
kernel, and in numpy.
"""

import functools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import array_of
from me2e_compress.operators.call import FusedCall
from me2e_compress.operators.grid_sampler import BILINEAR, grid_sample_array
from me2e_compress.operators.kernels.kernel import DOMAIN

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

    The result has the element type of ``value``.

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
    axes = [_neighbours(call, at, count) for at, count in ((x, columns), (y, height))]
    # Row 0 is the row of zeros
    padded = call.add("Pad", [value, call.integers([0, 1, 0, 0, 0, 0, 0, 0])])
    rows = call.reshape(padded, (-1, width))
    base = _first_rows(call, padded, starts)
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


def _neighbours(
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


def _first_rows(call: FusedCall, padded: ir.Value, starts: ir.Value) -> ir.Value:
    """Write the first row of image n, head m, level l: (n S + start + 1) M + m."""
    batch, length, heads = (call.size(padded, axis) for axis in (0, 1, 2))
    many = call.value_of(heads)
    starts = call.cast(starts, ir.DataType.INT64)
    level = call.add("Mul", [call.add("Add", [starts, call.integers([1])]), many])
    level = call.unsqueeze(level, (1,))
    head = call.unsqueeze(call.counting(heads), (1, 2))
    first = call.add("Add", [head, level])  # [M, L, 1]
    if batch == 1:
        return first
    step = call.value_of(call.product(length, heads))
    image = call.add("Mul", [call.counting(batch), step])
    return call.add("Add", [call.unsqueeze(image, (1, 2, 3, 4)), first])


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
