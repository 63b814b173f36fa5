"""A call of deformable attention: its inputs are checked, its blocks run on threads."""

from collections.abc import Callable, Mapping
from typing import Any

from numba import types

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.abi import (
    ADDRESS,
    EACH,
    TYPE,
    made,
    read,
    refused,
)
from me2e_compress.operators.kernels.intrinsics import (
    Word,
    address_of,
    call,
    compiled,
    stack,
    words,
)
from me2e_compress.operators.kernels.sampling import (
    OUT,
    SCALE,
    SCALES,
    SHAPES,
    STARTS,
    VALUE,
    WIDE_SHAPES,
    WIDE_STARTS,
    ZERO,
    D,
    L,
    M,
    N,
    P,
    Q,
    S,
    beyond,
    scaled,
)
from me2e_compress.operators.kernels.weighted_rows import CAPACITY

RANK_WRONG, SIZE_WRONG, NOT_WHOLE, BEYOND, TOO_LARGE, TOO_MANY, SCALE_WRONG = range(7)
"""Messages, as :mod:`kernel` lists them."""

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
    kind = next((_KINDS[each] for each in _KINDS if op_type.endswith(each)), None)
    inputs = ranks if kind is not None else ranks[:-2]
    compute = _compute(inputs, len(ranks) - 2, words_of_call, queries, take)
    return {"compute": compute, "block": block(kind or types.float32)}


def _compute(
    ranks: tuple[int, ...], scale: int, words_of_call: int, queries: int, take: Any
) -> Callable[[int, int], Word]:
    room, inputs = stack(types.int64, words_of_call), len(ranks)
    room_of_inputs = stack(types.int64, EACH * (scale + 2))
    quantized = inputs > scale

    def compute(state: int, context: int) -> Word:
        t, x, a = words(state), room_of_inputs(), room()
        # Read the inputs and check their ranks
        for i in range(EACH * (scale + 2)):
            x[i] = 0
        for i in range(inputs):
            rank = read(t, context, i, address_of(x) + 8 * EACH * i)
            if rank != ranks[i] and not (rank == 0 and i >= scale):
                return refused(t, RANK_WRONG)
            if rank == 0:
                x[EACH * i] = 1
        # Addresses, sizes and flags for the blocks
        a[VALUE], a[SHAPES] = x[ADDRESS], x[EACH + ADDRESS]
        a[STARTS] = x[2 * EACH + ADDRESS]
        a[N], a[S], a[M], a[D], a[L] = x[0], x[1], x[2], x[3], x[EACH]
        a[WIDE_SHAPES] = x[EACH + TYPE] == abi.INT64
        a[WIDE_STARTS] = x[2 * EACH + TYPE] == abi.INT64
        misfit = _misfit(a, x) if take(a, x) else SIZE_WRONG
        if misfit >= 0:
            return refused(t, misfit)
        a[SCALES] = 0
        if quantized:
            a[SCALE] = x[EACH * scale + ADDRESS]
            a[ZERO] = x[EACH * (scale + 1) + ADDRESS]
            if not scaled(a, x, scale):
                return refused(t, SCALE_WRONG)
        # Create the output
        x[0], x[1], x[2], x[3] = a[N], a[Q], a[M], a[D]
        status = made(t, context, x, 4, address_of(a) + 8 * OUT)
        if status != 0:
            return status
        # Run the blocks on the session's threads
        work = a[N] * ((a[Q] + queries - 1) // queries)
        if work * a[M] * a[D] == 0:
            return 0
        return call(t[abi.PARALLEL_FOR], context, t[abi.BLOCK], work, 0, address_of(a))

    return compute


@compiled
def _misfit(a: Any, x: Any) -> Word:
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
    return BEYOND if beyond(a) else -1
