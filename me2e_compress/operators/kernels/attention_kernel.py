"""The kernel of attention, whose scores are never all in memory.

Scores are computed for a block of keys at a time, and the softmax goes along (Dao et
al., FlashAttention, arXiv 2205.14135, algorithm 1). Everything is turned: rows are keys
or channels, and columns are queries, so that the softmax runs over vectors, and keys
and values are read where they lie.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numba import types

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.call_inputs import (
    ADDRESS,
    EACH,
    made,
    read,
    refused,
)
from me2e_compress.operators.kernels.intrinsics import (
    Word,
    address_of,
    call,
    compiled,
    floats,
    stack,
    words,
)
from me2e_compress.operators.kernels.kernel import WIDEST_HEAD
from me2e_compress.operators.kernels.matrix_tile import host_tile, matrix_product
from me2e_compress.operators.kernels.online_softmax import (
    MOST,
    SUM,
    softmax_step,
)

F = np.float32
LOG2_E = 1.4426950408889634

VECTORS = 3
WIDEST = host_tile(VECTORS)
TILE = dataclasses.replace(WIDEST, rows=8 if WIDEST.rows >= 8 else 4)
"""A power of two of rows, which divides the usual heads of 16 to 128 channels."""
WIDTH = TILE.width
"""Queries side by side: a panel."""

KEYS = 256
"""Keys at a time: their scores for a panel are 48 kB. Measured on AMD Zen 5: 128 take
3 % more time, 512 as much."""

PANELS = 4
"""Panels of a block at most: keys and values are read again for each block."""

CAPACITY = WIDEST_HEAD * WIDTH
"""Numbers of the queries of a block, and of its sums."""

# words of one call, as `compute` hands them to every `block`
QUERY, KEY, VALUE, OUT, N, Q, M, D, K = range(9)
WORDS = 9
RANK_WRONG, SIZE_WRONG, TOO_WIDE = range(3)
RANK = 4

_multiply = matrix_product(TILE)
_soften = softmax_step(TILE.vectors, TILE.lanes)

_words = stack(types.int64, WORDS)
_inputs = stack(types.int64, 3 * EACH)
_numbers = stack(types.float32, CAPACITY)
_scores = stack(types.float32, KEYS * WIDTH)
_state = stack(types.float32, 2 * WIDTH * PANELS)


@compiled
def _panels(a: Any) -> Word:
    """Return the panels of a block."""
    return min(PANELS, CAPACITY // (WIDTH * a[D]))


@compiled
def _turned(a: Any, query: int, count: int, to: int) -> None:
    """Write the queries of a panel as columns, times scale and log2(e)."""
    rows, columns, width = floats(query), floats(to), a[M] * a[D]
    factor = F(LOG2_E / math.sqrt(a[D]))
    for d in range(a[D]):
        for j in range(count):
            columns[d * WIDTH + j] = rows[j * width + d] * factor
        for j in range(count, WIDTH):
            columns[d * WIDTH + j] = F(0)


@compiled
def _keys(
    a: Any, key: int, value: int, count: int, q: int, s: int, r: int, o: int
) -> None:
    """Add a block of keys to the sums of a panel."""
    width = a[M] * a[D]
    _multiply(key, q, s, width, 1, WIDTH, WIDTH, count, WIDTH, a[D], 0)
    _soften(s, count, r, o, a[D])
    _multiply(value, s, o, 1, width, WIDTH, WIDTH, a[D], WIDTH, count, 1)


@compiled
def _written(a: Any, r: int, o: int, count: int, out: int) -> None:
    """Write the sums of a panel, divided by those of the powers, as rows."""
    rows, state, sums, width = floats(out), floats(r), floats(o), a[M] * a[D]
    for j in range(count):
        part = F(1) / state[SUM * WIDTH + j]
        for d in range(a[D]):
            rows[j * width + d] = sums[d * WIDTH + j] * part


def _block(user: int, index: int) -> Word:
    a = words(user)
    # The queries of this block
    panels, width = _panels(a), a[M] * a[D]
    blocks = (a[Q] + panels * WIDTH - 1) // (panels * WIDTH)
    both = index // blocks
    n, m = both // a[M], both % a[M]
    first = (index - both * blocks) * panels * WIDTH
    count = min(panels * WIDTH, a[Q] - first)
    panels = (count + WIDTH - 1) // WIDTH
    query = ((n * a[Q] + first) * width + m * a[D]) * 4
    q, s = address_of(_numbers()), address_of(_scores())
    r, o = address_of(_state()), address_of(_numbers())
    each = a[D] * WIDTH * 4
    # Start each panel
    for p in range(panels):
        left = min(WIDTH, count - p * WIDTH)
        _turned(a, a[QUERY] + query + p * WIDTH * width * 4, left, q + p * each)
        state, sums = floats(r + p * 8 * WIDTH), floats(o + p * each)
        for j in range(WIDTH):
            state[MOST * WIDTH + j] = F(-np.inf)
            state[SUM * WIDTH + j] = F(0)
        for j in range(a[D] * WIDTH):
            sums[j] = F(0)
    # A block of keys is read by all panels before the next one
    for k in range(0, a[K], KEYS):
        at = ((n * a[K] + k) * width + m * a[D]) * 4
        many = min(KEYS, a[K] - k)
        for p in range(panels):
            _keys(
                a, a[KEY] + at, a[VALUE] + at, many,
                q + p * each, s, r + p * 8 * WIDTH, o + p * each,
            )  # fmt: skip
    for p in range(panels):
        left = min(WIDTH, count - p * WIDTH)
        to = a[OUT] + query + p * WIDTH * width * 4
        _written(a, r + p * 8 * WIDTH, o + p * each, left, to)
    return 0


def _compute(state: int, context: int) -> Word:
    t, x, a = words(state), _inputs(), _words()
    # Read the inputs and check their sizes
    for i in range(3):
        if read(t, context, i, address_of(x) + 8 * EACH * i) != RANK:
            return refused(t, RANK_WRONG)
        a[i] = x[EACH * i + ADDRESS]
    a[N], a[Q], a[M], a[D], a[K] = x[0], x[1], x[2], x[3], x[EACH + 1]
    for i in range(RANK):
        if x[EACH + i] != x[2 * EACH + i] or (i != 1 and x[EACH + i] != x[i]):
            return refused(t, SIZE_WRONG)
    if a[K] == 0:
        return refused(t, SIZE_WRONG)
    if a[D] > WIDEST_HEAD:
        return refused(t, TOO_WIDE)
    # Create the output
    status = made(t, context, x, RANK, address_of(a) + 8 * OUT)
    if status != 0:
        return status
    if a[N] * a[Q] * a[M] * a[D] == 0:
        return 0
    # Run the blocks on the session's threads
    queries = _panels(a) * WIDTH
    work = a[N] * a[M] * ((a[Q] + queries - 1) // queries)
    return call(t[abi.PARALLEL_FOR], context, t[abi.BLOCK], work, 0, address_of(a))


def functions(op_type: str) -> Mapping[str, Callable[[int, int], Word]]:
    """Return the functions to compile for an operator of :mod:`kernel`."""
    return {"compute": _compute, "block": _block}
