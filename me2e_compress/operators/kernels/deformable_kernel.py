"""The kernel of multi-scale deformable attention, vectorized per block of queries.

For all points of one query the positions and weights of the four corners are computed
first; then the rows are summed (:func:`~vectors.weighted_rows`). All sizes are read at
run time, and loops are written so that LLVM vectorizes them.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numba import types

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.abi import ADDRESS, EACH, TYPE
from me2e_compress.operators.kernels.intrinsics import (
    Word,
    address_of,
    call,
    compiled,
    create_output,
    error_status,
    floats,
    ints,
    read_input,
    signed_bytes,
    stack,
    unsigned_bytes,
    words,
)
from me2e_compress.operators.kernels.vectors import CAPACITY, weighted_rows

F = np.float32
I32 = np.int32

# Words of one call, as `compute` passes them to every `block`: addresses and sizes
VALUE, SHAPES, STARTS, SCALE, ZERO, OUT = range(6)
N, S, M, D, L, Q, P, SCALES, WIDE_SHAPES, WIDE_STARTS = range(6, 16)
OTHERS = 16  # the first word that is a kernel's own

# Weights of four corners; then width and height of each point's level
corner_weights = stack(types.float32, 6 * CAPACITY)
# Offsets of four corners; then what `write_tables` writes
corner_offsets = stack(types.int32, 8 * CAPACITY)


@compiled
def _whole(address: int, index: int, wide: int) -> Word:
    """Read an int64 (``wide``) or int32 number of an array."""
    if wide:
        return words(address)[index]
    return np.int64(ints(address)[index])


@compiled
def _take_scale(a: Any, x: Any, scale: int) -> Word:
    """Read scale and zero point, inputs ``scale`` and the next; return if they fit."""
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
def write_tables(a: Any, w: Any, o: Any, heads: int, together: int) -> None:
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
def write_corners(
    w: Any, o: Any, places: Any, shares: Any, start: int, count: int, row: int
) -> None:
    """Write the weights and offsets of the four corners of every point."""
    # The constants of the points are those from `start` on. A position that is NaN
    # counts as outside. Points outside or without weight are not read: masked cameras
    # cost next to nothing, and a NaN there has no effect (in the body, 0 x NaN is NaN).
    for j in range(count):
        # Pixel position x W - 1/2, clipped to just outside: -1..W
        k = start + j
        width, height = w[4 * CAPACITY + k], w[5 * CAPACITY + k]
        x = places[2 * j] * width - F(0.5)
        y = places[2 * j + 1] * height - F(0.5)
        x = x if x > F(-1) else F(-1)
        x = x if x < width else width
        y = y if y > F(-1) else F(-1)
        y = y if y < height else height
        floor_x, floor_y = np.floor(x), np.floor(y)
        # Shares of the corners, bilinear: right = x - floor(x); 0 outside of the map
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
        # Offsets of the corners, clipped to the map: first + (y W + x) M D
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
def sum_of_weights(w: Any, first: int, last: int) -> Any:
    """Return the sum of all corners' weights, the factor of the zero point."""
    shares = F(0)
    for j in range(first, last):
        left = w[j] + w[2 * CAPACITY + j]
        right = w[CAPACITY + j] + w[3 * CAPACITY + j]
        shares += left + right
    return shares


@compiled
def dequantize_sums(a: Any, out: int, head: int, shares: Any) -> None:
    """Turn sums of one head's int8 values into sums of the numbers they stand for."""
    # sum w (q - zero) scale = (sum w q - zero sum w) scale
    numbers, scales = floats(out), floats(a[SCALE])
    zero = F(a[ZERO]) * shares
    if a[SCALES] == 1:
        for d in range(a[D]):
            numbers[d] = (numbers[d] - zero) * scales[0]
    else:
        for d in range(a[D]):
            numbers[d] = (numbers[d] - zero) * scales[head * a[D] + d]


# Messages, as `kernel` lists them
RANK_WRONG, SIZE_WRONG, NOT_WHOLE, BEYOND, TOO_LARGE, TOO_MANY, SCALE_WRONG = range(7)

_LARGEST = 2**31 - 1
_WHOLE = (abi.INT32, abi.INT64)
_KINDS = {"Uint8": types.uint8, "Int8": types.int8}


def functions_of(
    op_type: str,
    ranks: tuple[int, ...],
    words_of_call: int,
    queries: int,
    take: Any,
    block: Callable[[Any], Callable[[int, int], Word]],
) -> Mapping[str, Callable[[int, int], Word]]:
    """Return the functions to compile for an operator of :mod:`kernel`.

    Args:
        op_type: its name, which ends with the element type of int8 values.
        ranks: of the inputs: value, sizes and starts of levels, the kernel's own; the
            last two are scale and zero point, of int8 values only.
        words_of_call: how many words ``take`` and ``block`` use.
        queries: per block of work.
        take: the compiled function of words and inputs that takes a kernel's own inputs
            and the sizes Q and P, and returns whether sizes fit.
        block: makes the function of a block, for the element type of value.
    """
    kind = next((_KINDS[name] for name in _KINDS if op_type.endswith(name)), None)
    inputs = ranks if kind is not None else ranks[:-2]
    compute = _compute(inputs, len(ranks) - 2, words_of_call, queries, take)
    return {"compute": compute, "block": block(kind or types.float32)}


def _compute(
    ranks: tuple[int, ...], scale: int, words_of_call: int, queries: int, take: Any
) -> Callable[[int, int], Word]:
    """Return the function of a call: check inputs, make the output, run the blocks."""
    room_of_call, inputs = stack(types.int64, words_of_call), len(ranks)
    room_of_inputs = stack(types.int64, EACH * (scale + 2))

    def compute(state: int, context: int) -> Word:
        # Words of the runtime's functions, of the inputs, and of the call
        t, x, a = words(state), room_of_inputs(), room_of_call()
        # Read the inputs and check their ranks
        for i in range(EACH * (scale + 2)):
            x[i] = 0
        for i in range(inputs):
            rank = read_input(t, context, i, address_of(x) + 8 * EACH * i)
            if rank != ranks[i] and not (rank == 0 and i >= scale):
                return error_status(t, RANK_WRONG)
            if rank == 0:
                x[EACH * i] = 1
        # Addresses, sizes and flags for the blocks
        a[VALUE], a[SHAPES] = x[ADDRESS], x[EACH + ADDRESS]
        a[STARTS] = x[2 * EACH + ADDRESS]
        a[N], a[S], a[M], a[D], a[L] = x[0], x[1], x[2], x[3], x[EACH]
        a[WIDE_SHAPES] = x[EACH + TYPE] == abi.INT64
        a[WIDE_STARTS] = x[2 * EACH + TYPE] == abi.INT64
        misfit = _message_of_sizes(a, x) if take(a, x) else SIZE_WRONG
        if misfit >= 0:
            return error_status(t, misfit)
        a[SCALES] = 0
        if inputs > scale:  # of int8 values: scale and zero point
            a[SCALE] = x[EACH * scale + ADDRESS]
            a[ZERO] = x[EACH * (scale + 1) + ADDRESS]
            if not _take_scale(a, x, scale):
                return error_status(t, SCALE_WRONG)
        # Create the output
        x[0], x[1], x[2], x[3] = a[N], a[Q], a[M], a[D]
        status = create_output(t, context, x, 4, address_of(a) + 8 * OUT)
        if status != 0:
            return status
        # Run the blocks on the session's threads
        work = a[N] * ((a[Q] + queries - 1) // queries)
        if work * a[M] * a[D] == 0:
            return 0
        return call(t[abi.PARALLEL_FOR], context, t[abi.BLOCK], work, 0, address_of(a))

    return compute


@compiled
def _message_of_sizes(a: Any, x: Any) -> Word:
    """Return the index of the message for unfit levels or sizes; -1 if they fit."""
    if x[EACH + 1] != 2 or x[2 * EACH] != a[L]:
        return SIZE_WRONG
    if x[EACH + TYPE] not in _WHOLE or x[2 * EACH + TYPE] not in _WHOLE:
        return NOT_WHOLE
    s, m, d = a[S], a[M], a[D]
    if s > _LARGEST or m > _LARGEST or d > _LARGEST or s * m * d > _LARGEST:
        return TOO_LARGE
    if a[L] * a[P] > CAPACITY:
        return TOO_MANY
    # Every level must lie within the rows of value
    for k in range(a[L]):
        height = _whole(a[SHAPES], 2 * k, a[WIDE_SHAPES])
        width = _whole(a[SHAPES], 2 * k + 1, a[WIDE_SHAPES])
        first = _whole(a[STARTS], k, a[WIDE_STARTS])
        if height < 0 or width < 0 or first < 0:
            return BEYOND
        # Compare each alone first: products of huge numbers would overflow
        large = height > s or width > s or first > s or first + height * width > s
        if height > 0 and width > 0 and large:
            return BEYOND
    return -1


QUERIES = 128  # queries per block of work, few enough to balance the threads

PLACES, SHARES, SHARED, WORDS = range(OTHERS, OTHERS + 4)
RANKS = (4, 2, 1, 6, 5, 1, 1)


def _block(kind: Any) -> Callable[[int, int], Word]:
    sum_rows = weighted_rows(kind)
    bytes_each = kind.bitwidth // 8
    quantized = bytes_each == 1

    def block(user: int, index: int) -> Word:
        # The queries of this block: QUERIES of image n
        a = words(user)
        blocks = (a[Q] + QUERIES - 1) // QUERIES
        n = index // blocks
        from_query = (index - n * blocks) * QUERIES
        to_query = min(from_query + QUERIES, a[Q])
        points, row = a[L] * a[P], a[M] * a[D]
        at_once = a[M] if points == 0 else min(a[M], CAPACITY // points)
        if a[SHARED]:
            at_once = 1  # one head after the other samples the same places
        # Tables are the same for all queries
        w, o = corner_weights(), corner_offsets()
        write_tables(a, w, o, at_once, a[L])
        offsets, weights = address_of(o), address_of(w)
        for q in range(from_query, to_query):
            m = 0
            while m < a[M]:
                # As many heads at once as the tables hold
                heads = min(at_once, a[M] - m)
                first = (n * a[Q] + q) * a[M] + m
                sampled = n * a[Q] + q if a[SHARED] else first
                places = floats(a[PLACES] + sampled * points * 8)
                shares = floats(a[SHARES] + first * points * 4)
                write_corners(w, o, places, shares, 0, heads * points, row)
                rows = a[VALUE] + (n * a[S] * row + m * a[D]) * bytes_each
                out = a[OUT] + first * a[D] * 4
                for k in range(heads):
                    begin, end, to = k * points, (k + 1) * points, out + k * a[D] * 4
                    # out[m + k, :] = sum over points and corners of weight * row
                    sum_rows((rows, offsets, weights, begin, end, to, a[D]))
                    if quantized:
                        dequantize_sums(a, to, m + k, sum_of_weights(w, begin, end))
                m += at_once
        return 0

    return block


@compiled
def _take(a: Any, x: Any) -> Word:
    """Take positions and weights; return whether their sizes fit."""
    a[PLACES], a[SHARES] = x[3 * EACH + ADDRESS], x[4 * EACH + ADDRESS]
    # x[30:36] are N, Q, M or 1, L, P, 2 of the positions, x[40:45] those of the weights
    a[Q], a[P], a[SHARED] = x[31], x[34], x[32] == 1 and a[M] != 1
    for k in range(5):
        if x[40 + k] != x[30 + k] and not (k == 2 and x[32] == 1):
            return 0
    return x[30] == a[N] and x[33] == a[L] and x[35] == 2 and x[42] == a[M]


def functions(op_type: str) -> Mapping[str, Callable[[int, int], Word]]:
    """Return the functions to compile for an operator of :mod:`kernel`."""
    return functions_of(op_type, RANKS, WORDS, QUERIES, _take, _block)
