"""Bilinear samples of concatenated feature maps, for many points at a time.

The positions of points become weights and offsets of their four corners; all loops are
written so that LLVM vectorizes them. :mod:`weighted_rows` then sums the rows.
"""

from typing import Any

import numpy as np
from numba import types

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.abi import EACH, TYPE
from me2e_compress.operators.kernels.intrinsics import (
    Word,
    compiled,
    floats,
    ints,
    signed_bytes,
    stack,
    unsigned_bytes,
    words,
)
from me2e_compress.operators.kernels.weighted_rows import CAPACITY

F = np.float32
I32 = np.int32

VALUE, SHAPES, STARTS, SCALE, ZERO, OUT = range(6)
N, S, M, D, L, Q, P, SCALES, WIDE_SHAPES, WIDE_STARTS = range(6, 16)
"""Words of one call, as `compute` hands them to every `block`: addresses and sizes."""
OTHERS = 16
"""The first word that is a kernel's own."""

corner_weights = stack(types.float32, 6 * CAPACITY)
"""Weights of four corners; then width and height of each point's level."""
corner_offsets = stack(types.int32, 8 * CAPACITY)
"""Offsets of four corners; then what :func:`tables` writes."""


@compiled
def _whole(address: int, index: int, wide: int) -> Word:
    if wide:
        return words(address)[index]
    return np.int64(ints(address)[index])


@compiled
def beyond(a: Any) -> Word:
    """Return whether a level lies outside of the rows of value."""
    s = a[S]
    for k in range(a[L]):
        height = _whole(a[SHAPES], 2 * k, a[WIDE_SHAPES])
        width = _whole(a[SHAPES], 2 * k + 1, a[WIDE_SHAPES])
        first = _whole(a[STARTS], k, a[WIDE_STARTS])
        if height < 0 or width < 0 or first < 0:
            return 1
        # each alone first: products of absurd numbers would overflow
        large = height > s or width > s or first > s or first + height * width > s
        if height > 0 and width > 0 and large:
            return 1
    return 0


@compiled
def scaled(a: Any, x: Any, scale: int) -> Word:
    """Take scale and zero point, inputs ``scale`` and the next; return if they fit."""
    a[SCALES] = x[EACH * scale]
    if (a[SCALES] != 1 and a[SCALES] != a[M] * a[D]) or x[EACH * (scale + 1)] != 1:
        return 0
    zero = a[ZERO]
    if x[EACH * (scale + 1) + TYPE] == abi.INT8:
        a[ZERO] = np.int64(signed_bytes(zero)[0])
    else:
        a[ZERO] = np.int64(unsigned_bytes(zero)[0])
    return 1


@compiled
def tables(a: Any, w: Any, o: Any, heads: int, together: int) -> None:
    """Write the constants of every point of a query: sizes and offsets of its level.

    ``together`` levels stand beside each other, then heads: [levels / together, heads,
    together, P].
    """
    wide, row = a[WIDE_SHAPES], a[M] * a[D]
    for level in range(a[L]):
        height = _whole(a[SHAPES], 2 * level, wide)
        width = _whole(a[SHAPES], 2 * level + 1, wide)
        first = _whole(a[STARTS], level, a[WIDE_STARTS]) * row
        if height * width == 0:
            first = 0  # where there is nothing, nothing is read either
        group = level // together
        beside = level - group * together
        for m in range(heads):
            for p in range(a[P]):
                j = ((group * heads + m) * together + beside) * a[P] + p
                w[4 * CAPACITY + j] = F(width)
                w[5 * CAPACITY + j] = F(height)
                o[4 * CAPACITY + j] = I32(first + m * a[D])
                o[5 * CAPACITY + j] = I32(width - 1)
                o[6 * CAPACITY + j] = I32(height - 1)
                o[7 * CAPACITY + j] = I32(width * row)


@compiled
def corners(
    w: Any, o: Any, places: Any, shares: Any, start: int, count: int, row: int
) -> None:
    """Write the weights and offsets of the four corners of every point.

    The constants of the points are those from ``start`` on. A position that is NaN
    counts as outside. Points outside or without weight are not read: masked cameras
    cost next to nothing, and a NaN there has no effect (in the body, 0 x NaN is NaN).
    """
    for j in range(count):
        # Pixel position, clipped to just outside
        k = start + j
        width, height = w[4 * CAPACITY + k], w[5 * CAPACITY + k]
        x = places[2 * j] * width - F(0.5)
        y = places[2 * j + 1] * height - F(0.5)
        x = x if x > F(-1) else F(-1)
        x = x if x < width else width
        y = y if y > F(-1) else F(-1)
        y = y if y < height else height
        floor_x, floor_y = np.floor(x), np.floor(y)
        # Shares of the corners; 0 outside of the map
        right, below = x - floor_x, y - floor_y
        x0, y0 = I32(floor_x), I32(floor_y)
        last_x, last_y = o[5 * CAPACITY + k], o[6 * CAPACITY + k]
        left = F(1) - right if x0 >= 0 and x0 <= last_x else F(0)
        right = right if x0 < last_x else F(0)
        above = F(1) - below if y0 >= 0 and y0 <= last_y else F(0)
        below = below if y0 < last_y else F(0)
        share = shares[j]
        inside = left + right > F(0) and above + below > F(0) and share != F(0)
        w[j] = left * (above * share)
        w[CAPACITY + j] = right * (above * share)
        w[2 * CAPACITY + j] = left * (below * share)
        w[3 * CAPACITY + j] = right * (below * share)
        # Offsets of the corners, clipped to the map
        column = I32(max(min(x0, last_x), I32(0)) * row)
        following = I32(max(min(I32(x0 + 1), last_x), I32(0)) * row)
        first, stride = o[4 * CAPACITY + k], o[7 * CAPACITY + k]
        line = I32(max(min(y0, last_y), I32(0)) * stride + first)
        next_line = I32(max(min(I32(y0 + 1), last_y), I32(0)) * stride + first)
        o[j] = I32(line + column) if inside else I32(-1)
        o[CAPACITY + j] = I32(line + following)
        o[2 * CAPACITY + j] = I32(next_line + column)
        o[3 * CAPACITY + j] = I32(next_line + following)


@compiled
def share_of(w: Any, first: int, last: int) -> Any:
    """Return the sum of all corners' weights, which the zero point is worth."""
    shares = F(0)
    for j in range(first, last):
        left = w[j] + w[2 * CAPACITY + j]
        right = w[CAPACITY + j] + w[3 * CAPACITY + j]
        shares += left + right
    return shares


@compiled
def to_real(a: Any, out: int, head: int, shares: Any) -> None:
    """Turn the sums of one head over integers into those over the numbers meant."""
    numbers, scales = floats(out), floats(a[SCALE])
    zero = F(a[ZERO]) * shares
    if a[SCALES] == 1:
        for d in range(a[D]):
            numbers[d] = (numbers[d] - zero) * scales[0]
    else:
        for d in range(a[D]):
            numbers[d] = (numbers[d] - zero) * scales[head * a[D] + d]
