"""The kernel of 3x3 convolutions by Winograd's algorithm.

The transformed filters, if they are few, or else the inputs, are written first, for
all. Then each piece of work transforms some of the other, and multiplies it with all of
the first, while that is in the caches: a block of tiles, or a group of output channels.
"""

from collections.abc import Callable, Mapping
from typing import Any

from numba import types

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.call_context import (
    ADDRESS,
    EACH,
    borrow,
    give_back,
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
from me2e_compress.operators.kernels.vectors import LANES
from me2e_compress.operators.kernels.winograd_blocks import (
    ACROSS,
    DOWN,
    GROUP,
    HIGH,
    LEFT,
    OPTIONS,
    PANELS,
    PRODUCT_PLANE,
    TILES,
    TOP,
    WIDE,
    C,
    H,
    K,
    N,
    W,
    Y,
    filter_plane,
    input_plane,
    multiply,
    part,
    transform_filters,
    transform_inputs,
    write_outputs,
)
from me2e_compress.operators.kernels.winograd_transforms import FILTER, OUT, PRODUCTS

STRIPS = 16
"""Threads that can work at once: each has memory of its own."""

# words of one call, behind those of winograd_blocks
BLOCKS, SHARED, OWN, STRIDE, BY_BLOCK, FIRST_STAGE, PARTS = range(16, 23)
WORDS = 23

RANKS = (4, 4, 1, 1)
RANK_WRONG, SIZE_WRONG = range(2)
NUMBERS = 5
"""Numbers of the options: four pads, and whether negative results become 0."""

_words = stack(types.int64, WORDS)
_inputs = stack(types.int64, EACH * len(RANKS))
_held = stack(types.int64, 3)


@compiled
def _share(a: Any, index: int) -> None:
    """Transform the filters of one panel, or the inputs of one channel, for all."""
    depth = a[C]
    if a[BY_BLOCK]:
        plane = filter_plane(depth, part(a[K], LANES))
        transform_filters(a, index, a[SHARED] + index * depth * LANES * 4, plane)
    else:
        for block in range(a[BLOCKS]):
            to = block * PRODUCTS * input_plane(depth) + index * TILES
            transform_inputs(a, block, index, a[SHARED] + to * 4)


@compiled
def _work(a: Any, piece: int, m: int) -> None:
    """Write the outputs of a block for all groups, or of a group for all blocks."""
    depth, panels = a[C], part(a[K], LANES)
    own = m + (PRODUCTS * PRODUCT_PLANE + LANES) * 4
    # Transform what is this piece's own
    if a[BY_BLOCK]:
        plane, others = filter_plane(depth, panels), part(a[K], GROUP)
        for c in range(depth):
            transform_inputs(a, piece, c, own + c * TILES * 4)
    else:
        plane, others = filter_plane(depth, PANELS), a[BLOCKS]
        for k in range(min(PANELS, panels - piece * PANELS)):
            at = own + k * depth * LANES * 4
            transform_filters(a, piece * PANELS + k, at, plane)
    # Multiply it with all that is shared
    for other in range(others):
        block, group, filters, inputs = other, piece, own, a[SHARED]
        inputs += other * PRODUCTS * input_plane(depth) * 4
        if a[BY_BLOCK]:
            block, group, filters, inputs = piece, other, a[SHARED], own
            filters += other * GROUP * depth * 4
        first = group * GROUP
        wide = min(GROUP, a[K] - first)
        multiply(filters, plane, inputs, m, depth, wide)
        for channel in range(wide):
            write_outputs(a, block, first + channel, m + channel * TILES * 4)


def _block(user: int, index: int) -> Word:
    a = words(user)
    if a[FIRST_STAGE]:
        _share(a, index)
        return 0
    # Pieces that follow each other use the same memory
    pieces = a[BLOCKS] if a[BY_BLOCK] else part(a[K], GROUP)
    first, last = index * pieces // a[PARTS], (index + 1) * pieces // a[PARTS]
    for piece in range(first, last):
        _work(a, piece, a[OWN] + index * a[STRIDE])
    return 0


@compiled
def _sizes(a: Any, x: Any) -> Word:
    """Write the sizes of a call; return the index of a message, or -1."""
    a[N], a[C], a[H], a[W], a[K] = x[0], x[1], x[2], x[3], x[EACH + 3]
    filters = x[EACH] == FILTER and x[EACH + 1] == FILTER and x[EACH + 2] == a[C]
    if not filters or x[2 * EACH] != a[K] or x[3 * EACH] != NUMBERS:
        return SIZE_WRONG
    pads = words(a[OPTIONS])
    a[TOP], a[LEFT] = pads[0], pads[1]
    a[HIGH] = a[H] + pads[0] + pads[2] - FILTER + 1
    a[WIDE] = a[W] + pads[1] + pads[3] - FILTER + 1
    if a[HIGH] < 0 or a[WIDE] < 0:
        return SIZE_WRONG
    a[DOWN], a[ACROSS] = part(a[HIGH], OUT), part(a[WIDE], OUT)
    a[BLOCKS] = part(a[N] * a[DOWN] * a[ACROSS], TILES)
    return -1


@compiled
def _run(t: Any, context: int, a: Any) -> Word:
    """Run both stages on the session's threads."""
    # Filters are read again for each block, inputs for each group
    panels, held = part(a[K], LANES), _held()
    filters = PRODUCTS * filter_plane(a[C], panels) * 4
    inputs = PRODUCTS * input_plane(a[C]) * 4
    a[BY_BLOCK] = 2 * filters <= a[BLOCKS] * inputs
    # Memory for that, and for each part of the work
    shared, own, pieces = filters, inputs, a[BLOCKS]
    if not a[BY_BLOCK]:
        shared, own = a[BLOCKS] * inputs, PRODUCTS * filter_plane(a[C], PANELS) * 4
        pieces = part(a[K], GROUP)
    a[PARTS] = min(pieces, STRIPS)
    a[STRIDE] = own + (PRODUCTS * PRODUCT_PLANE + LANES) * 4
    status = borrow(t, context, shared + a[PARTS] * a[STRIDE], held)
    if status != 0:
        return status
    a[SHARED], a[OWN] = held[0], held[0] + shared
    # Run
    run, code, user = t[abi.PARALLEL_FOR], t[abi.BLOCK], address_of(a)
    a[FIRST_STAGE] = 1
    status = call(run, context, code, panels if a[BY_BLOCK] else a[C], 0, user)
    a[FIRST_STAGE] = 0
    if status == 0:
        status = call(run, context, code, a[PARTS], 0, user)
    give_back(t, held)
    return status


def _compute(state: int, context: int) -> Word:
    t, x, a = words(state), _inputs(), _words()
    # Read the inputs
    for i in range(len(RANKS)):
        rank = read(t, context, i, address_of(x) + 8 * EACH * i)
        if rank != RANKS[i]:
            return refused(t, RANK_WRONG)
        a[i] = x[EACH * i + ADDRESS]
    misfit = _sizes(a, x)
    if misfit >= 0:
        return refused(t, misfit)
    # Create the output
    x[0], x[1], x[2], x[3] = a[N], a[K], a[HIGH], a[WIDE]
    status = made(t, context, x, 4, address_of(a) + 8 * Y)
    if status != 0 or a[BLOCKS] * a[K] == 0:
        return status
    return _run(t, context, a)


def functions(op_type: str) -> Mapping[str, Callable[[int, int], Word]]:
    """Return the functions to compile for the operator."""
    return {"compute": _compute, "block": _block}
