"""The kernel of multi-scale deformable attention, vectorized per block of queries.

For all points of one query the positions and weights of the four corners are computed
first; then the rows are summed (:mod:`weighted_rows`). All sizes are read at run time.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numba import types

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.intrinsics import (
    Word,
    address_of,
    call,
    compiled,
    floats,
    ints,
    signed_bytes,
    stack,
    unsigned_bytes,
    words,
)
from me2e_compress.operators.kernels.weighted_rows import CAPACITY, weighted_rows

F = np.float32
I32 = np.int32
QUERIES = 128
"""Queries per block of work, few enough to balance the threads."""

# words of one call, as `compute` hands them to every `block`
VALUE, SHAPES, STARTS, PLACES, SHARES, SCALE, ZERO, OUT = range(8)
N, S, M, D, L, Q, P, SCALES, WIDE_SHAPES, WIDE_STARTS, SHARED = range(8, 19)
WORDS = 19

RANKS = (4, 2, 1, 6, 5, 1, 1)
RANK_WRONG, SIZE_WRONG, NOT_WHOLE, BEYOND, TOO_LARGE, TOO_MANY, SCALE_WRONG = range(7)

# ten words an input: eight dimensions, then
ADDRESS, TYPE, EACH = 8, 9, 10
WHOLE = (abi.INT32, abi.INT64)
LARGEST = 2**31 - 1

_floats = stack(types.float32, 6 * CAPACITY)
_ints = stack(types.int32, 8 * CAPACITY)
_words = stack(types.int64, WORDS)
_inputs = stack(types.int64, EACH * len(RANKS))
_slot = stack(types.int64, 1)


@compiled
def _whole(address: int, index: int, wide: int) -> Word:
    if wide:
        return words(address)[index]
    return np.int64(ints(address)[index])


@compiled
def _tables(a: Any, w: Any, o: Any, heads: int) -> None:
    """Write the constants of every point of a query: sizes and offsets of its level."""
    wide, row = a[WIDE_SHAPES], a[M] * a[D]
    for level in range(a[L]):
        height = _whole(a[SHAPES], 2 * level, wide)
        width = _whole(a[SHAPES], 2 * level + 1, wide)
        first = _whole(a[STARTS], level, a[WIDE_STARTS]) * row
        if height * width == 0:
            first = 0  # where there is nothing, nothing is read either
        for m in range(heads):
            for p in range(a[P]):
                j = (m * a[L] + level) * a[P] + p
                w[4 * CAPACITY + j] = F(width)
                w[5 * CAPACITY + j] = F(height)
                o[4 * CAPACITY + j] = I32(first + m * a[D])
                o[5 * CAPACITY + j] = I32(width - 1)
                o[6 * CAPACITY + j] = I32(height - 1)
                o[7 * CAPACITY + j] = I32(width * row)


@compiled
def _corners(w: Any, o: Any, places: Any, shares: Any, count: int, row: int) -> None:
    """Write the weights and offsets of the four corners of every point.

    A position that is NaN counts as outside. Points outside or without weight are not
    read: masked cameras cost next to nothing, and a NaN there has no effect (in the
    body, 0 x NaN is NaN).
    """
    for j in range(count):
        # Pixel position, clipped to just outside
        width, height = w[4 * CAPACITY + j], w[5 * CAPACITY + j]
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
        last_x, last_y = o[5 * CAPACITY + j], o[6 * CAPACITY + j]
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
        first, stride = o[4 * CAPACITY + j], o[7 * CAPACITY + j]
        line = I32(max(min(y0, last_y), I32(0)) * stride + first)
        next_line = I32(max(min(I32(y0 + 1), last_y), I32(0)) * stride + first)
        o[j] = I32(line + column) if inside else I32(-1)
        o[CAPACITY + j] = I32(line + following)
        o[2 * CAPACITY + j] = I32(next_line + column)
        o[3 * CAPACITY + j] = I32(next_line + following)


@compiled
def _to_real(a: Any, w: Any, out: int, head: int, first: int, last: int) -> None:
    numbers, scales = floats(out), floats(a[SCALE])
    shares = F(0)
    for j in range(first, last):
        left = w[j] + w[2 * CAPACITY + j]
        right = w[CAPACITY + j] + w[3 * CAPACITY + j]
        shares += left + right
    zero = F(a[ZERO]) * shares
    if a[SCALES] == 1:
        for d in range(a[D]):
            numbers[d] = (numbers[d] - zero) * scales[0]
    else:
        for d in range(a[D]):
            numbers[d] = (numbers[d] - zero) * scales[head * a[D] + d]


def _block(kind: Any) -> Callable[[int, int], Word]:
    sum_rows = weighted_rows(kind)
    bytes_each = kind.bitwidth // 8
    quantized = bytes_each == 1

    def block(user: int, index: int) -> Word:
        # The queries of this block
        a = words(user)
        blocks = (a[Q] + QUERIES - 1) // QUERIES
        n = index // blocks
        from_query = (index - n * blocks) * QUERIES
        to_query = min(from_query + QUERIES, a[Q])
        points, row = a[L] * a[P], a[M] * a[D]
        at_once = a[M] if points == 0 else min(a[M], CAPACITY // points)
        if a[SHARED]:
            at_once = 1  # one head after the other looks at the same places
        # Tables are the same for all queries
        w, o = _floats(), _ints()
        _tables(a, w, o, at_once)
        for q in range(from_query, to_query):
            m = 0
            while m < a[M]:
                # As many heads at once as the tables hold
                heads = min(at_once, a[M] - m)
                first = (n * a[Q] + q) * a[M] + m
                looked_at = n * a[Q] + q if a[SHARED] else first
                places = floats(a[PLACES] + looked_at * points * 8)
                shares = floats(a[SHARES] + first * points * 4)
                _corners(w, o, places, shares, heads * points, row)
                rows = a[VALUE] + (n * a[S] * row + m * a[D]) * bytes_each
                out = a[OUT] + first * a[D] * 4
                for k in range(heads):
                    begin, end, to = k * points, (k + 1) * points, out + k * a[D] * 4
                    sum_rows(rows, o, w, begin, end, to, a[D])
                    if quantized:
                        _to_real(a, w, to, m + k, begin, end)
                m += at_once
        return 0

    return block


@compiled
def _refused(t: Any, message: int) -> Word:
    create, said = t[abi.CREATE_STATUS], t[abi.MESSAGES + message]
    return call(create, abi.INVALID_ARGUMENT, said, 0, 0, 0)


@compiled
def _read(t: Any, context: int, index: int, to: int) -> Word:
    """Read an input into ten words (dimensions, address, type) and return its rank.

    More than eight dimensions are not read.
    """
    slot = _slot()
    at = address_of(slot)
    call(t[abi.GET_INPUT], context, index, at, 0, 0)
    tensor = slot[0]
    call(t[abi.GET_DATA], tensor, to + ADDRESS * 8, 0, 0, 0)
    call(t[abi.GET_INFO], tensor, at, 0, 0, 0)
    info = slot[0]
    call(t[abi.GET_TYPE], info, to + TYPE * 8, 0, 0, 0)
    call(t[abi.GET_RANK], info, at, 0, 0, 0)
    rank = slot[0]
    if rank <= ADDRESS:
        call(t[abi.GET_DIMS], info, to, rank, 0, 0)
    call(t[abi.RELEASE_INFO], info, 0, 0, 0, 0)
    return rank


@compiled
def _misfit(a: Any, x: Any) -> Word:
    """Return the index of the message for unfit inputs; -1 if they fit."""
    # Sizes must agree between the inputs
    s, m, d, levels, points = x[1], x[2], x[3], x[10], x[34]
    same = x[30] == x[0] and x[33] == levels and x[35] == 2 and x[42] == m
    if not (same and x[11] == 2 and x[20] == levels):
        return SIZE_WRONG
    for k in range(5):
        if x[40 + k] != x[30 + k] and not (k == 2 and x[32] == 1):
            return SIZE_WRONG
    if x[10 + TYPE] not in WHOLE or x[20 + TYPE] not in WHOLE:
        return NOT_WHOLE
    if s > LARGEST or m > LARGEST or d > LARGEST or s * m * d > LARGEST:
        return TOO_LARGE
    if levels * points > CAPACITY:
        return TOO_MANY
    # Every level must lie within the rows of value
    for k in range(levels):
        height = _whole(a[SHAPES], 2 * k, a[WIDE_SHAPES])
        width = _whole(a[SHAPES], 2 * k + 1, a[WIDE_SHAPES])
        first = _whole(a[STARTS], k, a[WIDE_STARTS])
        if height < 0 or width < 0 or first < 0:
            return BEYOND
        # each alone first: products of absurd numbers would overflow
        large = height > s or width > s or first > s or first + height * width > s
        if height > 0 and width > 0 and large:
            return BEYOND
    return -1


def _compute(inputs: int) -> Callable[[int, int], Word]:

    def compute(state: int, context: int) -> Word:
        t, x, a = words(state), _inputs(), _words()
        # Read the inputs and check their ranks
        for i in range(EACH * len(RANKS)):
            x[i] = 0
        for i in range(inputs):
            rank = _read(t, context, i, address_of(x) + 8 * EACH * i)
            if rank != RANKS[i] and not (rank == 0 and i >= SCALE):
                return _refused(t, RANK_WRONG)
            if rank == 0:
                x[EACH * i] = 1
        for i in range(len(RANKS)):
            a[i] = x[EACH * i + ADDRESS]
        # Sizes and flags for the blocks
        a[N], a[S], a[M], a[D] = x[0], x[1], x[2], x[3]
        a[L], a[Q], a[P], a[SCALES] = x[10], x[31], x[34], x[EACH * SCALE]
        a[SHARED] = x[32] == 1 and a[M] != 1
        a[WIDE_SHAPES] = x[10 + TYPE] == abi.INT64
        a[WIDE_STARTS] = x[20 + TYPE] == abi.INT64
        misfit = _misfit(a, x)
        if misfit >= 0:
            return _refused(t, misfit)
        # Scale and zero point of quantized values
        if inputs > SCALE:
            if (a[SCALES] != 1 and a[SCALES] != a[M] * a[D]) or x[EACH * ZERO] != 1:
                return _refused(t, SCALE_WRONG)
            zero = a[ZERO]
            if x[EACH * ZERO + TYPE] == abi.INT8:
                a[ZERO] = np.int64(signed_bytes(zero)[0])
            else:
                a[ZERO] = np.int64(unsigned_bytes(zero)[0])
        # Create the output
        x[0], x[1], x[2], x[3] = a[N], a[Q], a[M], a[D]
        status = call(t[abi.GET_OUTPUT], context, 0, address_of(x), 4, address_of(a))
        if status != 0:
            return status
        tensor = a[0]
        a[0] = x[ADDRESS]
        call(t[abi.GET_DATA], tensor, address_of(x), 0, 0, 0)
        a[OUT] = x[0]
        # Run the blocks on the session's threads
        work = a[N] * ((a[Q] + QUERIES - 1) // QUERIES)
        if work * a[M] * a[D] == 0:
            return 0
        return call(t[abi.PARALLEL_FOR], context, t[abi.BLOCK], work, 0, address_of(a))

    return compute


def functions(op_type: str) -> Mapping[str, Callable[[int, int], Word]]:
    """Return the functions to compile for an operator of :mod:`kernel`."""
    kinds = {"Uint8": types.uint8, "Int8": types.int8}
    kind = next((kinds[each] for each in kinds if op_type.endswith(each)), None)
    if kind is None:
        return {"compute": _compute(SCALE), "block": _block(types.float32)}
    return {"compute": _compute(len(RANKS)), "block": _block(kind)}
