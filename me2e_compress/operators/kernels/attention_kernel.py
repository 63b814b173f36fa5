"""The kernel of attention, which never stores all scores.

Scores are computed for one block of keys at a time (Dao et al., FlashAttention, arXiv
2205.14135, algorithm 1). All matrices are transposed: rows are keys or channels, and
columns are queries, so that the softmax runs over vectors, and keys and values need no
copy.

The softmax is updated block by block (Milakov and Gimelshein, Online normalizer
calculation for softmax, arXiv 1805.02867, algorithm 3): it keeps the largest score and
the sum of powers so far, and corrects the sums where a block has a larger score. Powers
are of 2: callers multiply scores by log2(e). It is written as LLVM instructions, since
a call of C's ``exp2f`` is not vectorized.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.abi import ADDRESS, EACH
from me2e_compress.operators.kernels.intrinsics import (
    WORD,
    Word,
    address_of,
    call,
    compiled,
    create_output,
    error_status,
    floats,
    read_input,
    stack,
    words,
)
from me2e_compress.operators.kernels.kernel import WIDEST_HEAD
from me2e_compress.operators.kernels.vectors import (
    LOG2_E,
    Vectors,
    host_tile,
    matrix_product,
    vector_intrinsic,
)

MOST, SUM = range(2)  # rows of a step's state


def softmax_step(vectors: int, lanes: int) -> Any:
    """Return the intrinsic ``((scores, count, state, sums, channels))``.

    ``scores``, ``state`` and ``sums`` are addresses of float32 rows of ``vectors *
    lanes`` queries side by side. It replaces ``count`` rows of scores by powers,
    2^(score - the largest so far), and brings the state up to date: the largest score
    and the sum of all powers, at the start -infinity and 0. The ``channels`` rows of
    sums, which were weighted by the powers before, are corrected. NaN gives NaN.
    """
    return vector_intrinsic(
        lambda simd, *words: _Step(simd, vectors, *words).write(), lanes
    )


class _Step:
    """Writes the loops of a step: largest scores, corrected sums, powers."""

    def __init__(
        self, simd: Vectors, vectors: int,
        scores: Any, count: Any, state: Any, sums: Any, channels: Any,
    ) -> None:  # fmt: skip
        self.builder, self.simd, self.vectors = simd.builder, simd, vectors
        self.scores, self.state = simd.pointer(scores), simd.pointer(state)
        self.sums = simd.pointer(sums)
        self.count, self.channels = count, channels

    def write(self) -> None:
        builder = self.builder
        before = self._row(self.state, WORD(MOST))
        # new = max(old, scores), in variables that LLVM keeps in registers
        largest = [self._variable(vector) for vector in before]
        with cgutils.for_range(builder, self.count) as loop:
            scores = self._row(self.scores, loop.index)
            for most, score in zip(largest, scores, strict=True):
                old = builder.load(most)
                more = builder.fcmp_unordered(">", score, old)
                builder.store(builder.select(more, score, old), most)
        most = [builder.load(variable) for variable in largest]
        self._set_row(self.state, WORD(MOST), most)
        # What was summed before has powers of score - old: times 2^(old - new)
        corrections = [
            self.simd.power_of_2(builder.fsub(old, new))
            for old, new in zip(before, most, strict=True)
        ]
        row = zip(self._row(self.state, WORD(SUM)), corrections, strict=True)
        totals = [self._variable(builder.fmul(old, factor)) for old, factor in row]
        with cgutils.for_range(builder, self.channels) as loop:
            row = zip(self._row(self.sums, loop.index), corrections, strict=True)
            corrected = [builder.fmul(total, factor) for total, factor in row]
            self._set_row(self.sums, loop.index, corrected)
        # 2^(score - new), and the total of these
        with cgutils.for_range(builder, self.count) as loop:
            row = zip(self._row(self.scores, loop.index), most, strict=True)
            powers = [
                self.simd.power_of_2(builder.fsub(score, new)) for score, new in row
            ]
            self._set_row(self.scores, loop.index, powers)
            for total, power in zip(totals, powers, strict=True):
                builder.store(builder.fadd(builder.load(total), power), total)
        self._set_row(self.state, WORD(SUM), [builder.load(total) for total in totals])

    def _variable(self, vector: Any) -> Any:
        return cgutils.alloca_once_value(self.builder, vector)

    def _row(self, rows: Any, index: Any) -> list[Any]:
        return [self.simd.load(place) for place in self._places(rows, index)]

    def _set_row(self, rows: Any, index: Any, row: list[Any]) -> None:
        for vector, place in zip(row, self._places(rows, index), strict=True):
            self.simd.store(vector, place)

    def _places(self, rows: Any, index: Any) -> list[Any]:
        builder, lanes = self.builder, self.simd.lanes
        first = builder.mul(index, WORD(self.vectors * lanes))
        offsets = [builder.add(first, WORD(n * lanes)) for n in range(self.vectors)]
        return [builder.gep(rows, [offset]) for offset in offsets]


F = np.float32

VECTORS = 3
_LARGEST = host_tile(VECTORS)
# A power of two of rows, which divides the usual heads of 16 to 128 channels
TILE = dataclasses.replace(_LARGEST, rows=8 if _LARGEST.rows >= 8 else 4)

WIDTH = TILE.width  # queries side by side: a panel

STATE = 2 * WIDTH  # numbers of a panel's state

# Keys at a time: their scores for a panel are 48 kB. Measured on AMD Zen 5: 128 take 3
# % more time, 512 as much.
KEYS = 256

PANELS = 4  # panels of a block at most: keys and values are read again for each block

CAPACITY = WIDEST_HEAD * WIDTH  # numbers of the queries of a block, and of its sums

# Words of one call, as `compute` passes them to every `block`: four addresses, sizes,
# ROW numbers from one query or key to the next, QUERIES in a block, BLOCKS of a head
QUERY, KEY, VALUE, OUT, N, Q, M, D, K, ROW, QUERIES, BLOCKS = range(12)
WORDS = 12
RANK_WRONG, SIZE_WRONG, TOO_WIDE = range(3)
RANK = 4

_multiply = matrix_product(TILE)
_soften = softmax_step(TILE.vectors, TILE.lanes)

_words = stack(types.int64, WORDS)
_inputs = stack(types.int64, 3 * EACH)
_numbers = stack(types.float32, CAPACITY)
_scores = stack(types.float32, KEYS * WIDTH)
_states = stack(types.float32, PANELS * STATE)


@compiled
def _begin(a: Any, query: int, count: int, columns: Any, state: Any, sums: Any) -> None:
    """Write the queries of a panel as columns, times scale and log2(e); clear it."""
    rows, factor = floats(query), F(LOG2_E / math.sqrt(a[D]))
    for d in range(a[D]):
        for j in range(count):
            columns[d * WIDTH + j] = rows[j * a[ROW] + d] * factor
    for j in range(WIDTH):
        state[MOST * WIDTH + j] = F(-np.inf)
        state[SUM * WIDTH + j] = F(0)
    for j in range(a[D] * WIDTH):
        sums[j] = F(0)


def _block(user: int, index: int) -> Word:
    a = words(user)
    # The queries of this block, and how many panels they are
    head = index // a[BLOCKS]
    n, m = head // a[M], head % a[M]
    first = (index - head * a[BLOCKS]) * a[QUERIES]
    count = min(a[QUERIES], a[Q] - first)
    panels, size = (count + WIDTH - 1) // WIDTH, a[D] * WIDTH * 4
    q, s = address_of(_numbers()), address_of(_scores())  # (D, WIDTH), (KEYS, WIDTH)
    r, o = address_of(_states()), address_of(_numbers())  # (2, WIDTH), (D, WIDTH)
    rows = ((n * a[Q] + first) * a[ROW] + m * a[D]) * 4
    for p in range(panels):
        left, at = min(WIDTH, count - p * WIDTH), rows + p * WIDTH * a[ROW] * 4
        state, sums = floats(r + p * STATE * 4), floats(o + p * size)
        _begin(a, a[QUERY] + at, left, floats(q + p * size), state, sums)
    # All panels read a block of keys before the next one
    for k in range(0, a[K], KEYS):
        at = ((n * a[K] + k) * a[ROW] + m * a[D]) * 4
        key, value, many = a[KEY] + at, a[VALUE] + at, min(KEYS, a[K] - k)
        for p in range(panels):
            # Columns that no query fills hold anything; nothing of them is read
            left, out = min(WIDTH, count - p * WIDTH), o + p * size
            # s = key q: (keys, D) (D, queries)
            sizes = (a[ROW], 1, WIDTH, WIDTH, many, left, a[D], 0)
            _multiply((key, q + p * size, s, *sizes))
            # s = 2^(s - largest), and o corrected to the new largest
            _soften((s, many, r + p * STATE * 4, out, a[D]))
            # o += value^T s: (D, keys) (keys, queries)
            sizes = (1, a[ROW], WIDTH, WIDTH, a[D], left, many, 1)
            _multiply((value, s, out, *sizes))
    for p in range(panels):
        # out[j, d] = o[d, j] / sum of powers of query j
        left, at = min(WIDTH, count - p * WIDTH), rows + p * WIDTH * a[ROW] * 4
        state, sums = floats(r + p * STATE * 4), floats(o + p * size)
        out_rows = floats(a[OUT] + at)
        for j in range(left):
            part = F(1) / state[SUM * WIDTH + j]
            for d in range(a[D]):
                out_rows[j * a[ROW] + d] = sums[d * WIDTH + j] * part
    return 0


def _compute(state: int, context: int) -> Word:
    t, x, a = words(state), _inputs(), _words()
    # Read the inputs and check their sizes
    for i in range(3):
        if read_input(t, context, i, address_of(x) + 8 * EACH * i) != RANK:
            return error_status(t, RANK_WRONG)
        a[i] = x[EACH * i + ADDRESS]
    # Key and value are alike, and like query but for the number of rows
    for i in range(RANK):
        if x[EACH + i] != x[2 * EACH + i] or (i != 1 and x[EACH + i] != x[i]):
            return error_status(t, SIZE_WRONG)
    a[N], a[Q], a[M], a[D], a[K] = x[0], x[1], x[2], x[3], x[EACH + 1]
    if a[K] == 0:
        return error_status(t, SIZE_WRONG)
    if a[D] > WIDEST_HEAD:
        return error_status(t, TOO_WIDE)
    # Create the output
    status = create_output(t, context, x, RANK, address_of(a) + 8 * OUT)
    if status != 0 or a[N] * a[Q] * a[M] * a[D] == 0:
        return status
    # Run the blocks on the session's threads
    a[ROW] = a[M] * a[D]
    a[QUERIES] = min(PANELS, CAPACITY // (WIDTH * a[D])) * WIDTH
    a[BLOCKS] = (a[Q] + a[QUERIES] - 1) // a[QUERIES]
    work = a[N] * a[M] * a[BLOCKS]
    return call(t[abi.PARALLEL_FOR], context, t[abi.BLOCK], work, 0, address_of(a))


def functions(op_type: str) -> Mapping[str, Callable[[int, int], Word]]:
    """Return the functions to compile for an operator of :mod:`kernel`."""
    return {"compute": _compute, "block": _block}
