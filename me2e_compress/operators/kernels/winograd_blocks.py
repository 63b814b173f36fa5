"""Pieces of a Winograd convolution: filters of a panel, inputs and outputs of a block.

Tiles of all images are counted row by row, and taken in blocks; output channels in
groups of panels of 16. Transformed filters of some panels are [36, panels, C, 16],
transformed inputs of a block [36, C, tiles], products [36, group, tiles].
"""

import dataclasses
from typing import Any

import numpy as np
from numba import types

from me2e_compress.operators.kernels.intrinsics import (
    Word,
    address_of,
    compiled,
    floats,
    stack,
    words,
)
from me2e_compress.operators.kernels.matrix_tile import host_tile, matrix_product
from me2e_compress.operators.kernels.vectors import LANES
from me2e_compress.operators.kernels.winograd_transforms import (
    OUT,
    PRODUCTS,
    SIDE,
    filters,
    input_columns,
    input_rows,
    outputs,
)

TILES = 48
"""Tiles per block."""

GROUP = 64
"""Output channels per group. Their products with a block, 442 kB, and the transformed
inputs of 64 channels fit into a second cache of 1 MB."""

PANELS = GROUP // LANES

AHEAD = 4
"""Channels by which filters are fetched ahead."""

ROW = OUT * TILES + LANES
"""Columns of one row of input tiles of a block."""

PRODUCT_PLANE = GROUP * TILES + LANES
"""Numbers from one of the 36 products to the next, a vector more than needed here and
below: planes of a multiple of 4 kB would all share the same sets of the first cache."""

# words of one call
X, FILTERS, BIAS, OPTIONS, Y = range(5)
N, C, H, W, K, TOP, LEFT, HIGH, WIDE, DOWN, ACROSS = range(5, 16)
RELU = 4
"""The index of the flag among the options, behind the pads."""

_rows = stack(types.float32, SIDE * ROW)
_ends = stack(types.float32, 2)
_host = host_tile(3)
_multiply = matrix_product(dataclasses.replace(_host, rows=8 if _host.rows > 7 else 4))


@compiled
def part(total: int, size: int) -> Word:
    """Return how many parts of a size a total has, the last one perhaps smaller."""
    return (total + size - 1) // size


@compiled
def filter_plane(depth: int, panels: int) -> Word:
    """Return the numbers from one of the 36 planes of filters to the next."""
    return (panels * depth + 1) * LANES


@compiled
def input_plane(depth: int) -> Word:
    """Return the numbers from one of the 36 planes of inputs to the next."""
    return depth * TILES + LANES


@compiled
def transform_filters(a: Any, panel: int, to: int, plane: int) -> None:
    """Write the transformed filters of one panel."""
    depth, wide = a[C], a[K]
    for c in range(depth):
        elements = a[FILTERS] + (c * wide + panel * LANES) * 4
        at = to + c * LANES * 4
        count = wide - panel * LANES
        filters((elements, depth * wide, count, at, plane, AHEAD * wide))


@compiled
def transform_inputs(a: Any, block: int, c: int, to: int) -> None:
    """Write the transformed inputs of one block for one channel."""
    rows, plane = address_of(_rows()), input_plane(a[C])
    size, start = a[DOWN] * a[ACROSS], block * TILES
    end, tile = min(start + TILES, a[N] * size), start
    while tile < end:
        # Tiles side by side in one image
        n = tile // size
        down = (tile - n * size) // a[ACROSS]
        across = tile - n * size - down * a[ACROSS]
        count = min(a[ACROSS] - across, end - tile)
        image = a[X] + (n * a[C] + c) * a[H] * a[W] * 4
        y, x = down * OUT - a[TOP], across * OUT - a[LEFT]
        for k in range(0, OUT * count + SIDE - OUT, LANES):
            input_rows((image, y, a[H], x + k, a[W], rows + k * 4, ROW))
        for k in range(0, count, LANES):
            at = to + (tile - start + k) * 4
            input_columns((rows + k * OUT * 4, ROW, at, plane, count - k))
        tile += count


@compiled
def multiply(made: int, plane: int, read: int, to: int, depth: int, wide: int) -> None:
    """Write 36 products of ``wide`` filters with the inputs of one block."""
    for k in range(PRODUCTS):
        right = read + k * input_plane(depth) * 4
        for channel in range(0, wide, LANES):
            left = made + (k * plane + channel * depth) * 4
            at = to + (k * PRODUCT_PLANE + channel * TILES) * 4
            _multiply(left, right, at, 1, LANES, TILES, TILES, LANES, TILES, depth, 0)


@compiled
def write_outputs(a: Any, block: int, channel: int, m: int) -> None:
    """Transform the products of one channel and block, and write the outputs."""
    size, start = a[DOWN] * a[ACROSS], block * TILES
    end, tile = min(start + TILES, a[N] * size), start
    ends, options = _ends(), words(a[OPTIONS])
    ends[0] = floats(a[BIAS])[channel]
    ends[1] = np.float32(0) if options[RELU] else -np.inf
    while tile < end:
        # Tiles side by side in one image
        n = tile // size
        down = (tile - n * size) // a[ACROSS]
        across = tile - n * size - down * a[ACROSS]
        count = min(a[ACROSS] - across, end - tile)
        y, x = down * OUT, across * OUT
        to = a[Y] + (((n * a[K] + channel) * a[HIGH] + y) * a[WIDE] + x) * 4
        columns = min(count * OUT, a[WIDE] - x)
        for k in range(0, count, LANES):
            products, at = m + (tile - start + k) * 4, to + k * OUT * 4
            limits = (a[WIDE], a[HIGH] - y, columns - k * OUT, a[HIGH] * a[WIDE])
            outputs((products, PRODUCT_PLANE, address_of(ends), at, *limits))
        tile += count
