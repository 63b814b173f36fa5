"""The kernel of 3x3 convolutions by Winograd's algorithm F(4x4, 3x3).

Y = A^T [(G g G^T) * (B^T d B)] A (Lavin and Gray, arXiv 1509.09308, equation 8), with
the matrices of Cook and Toom for the points 0, +-sqrt(1/2), +-sqrt(2) and infinity:
their rounding error in float32 is half of that of 0, +-1, +-2, infinity (6 dB measured,
see Barabasz et al., arXiv 1803.10986, on the choice of points). A point and its
negative share their even and odd parts. Every lane of a vector is one tile, but for
the filters, where it is one output channel.

The transformed filters, if they are few, or else the inputs, are written first, for
all. Then each piece of work transforms some of the other, and multiplies it with all of
the first, while that is in the caches: a block of tiles, or a group of output channels.
Tiles of all images are counted row by row, and taken in blocks; output channels in
groups of panels of 16. Transformed filters of some panels are [36, panels, C, 16],
transformed inputs of a block [36, C, tiles], products [36, group, tiles].
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numba import types

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.abi import ADDRESS, EACH
from me2e_compress.operators.kernels.intrinsics import (
    WORD,
    Word,
    address_of,
    allocate_memory,
    call,
    compiled,
    create_output,
    error_status,
    floats,
    free_memory,
    read_input,
    stack,
    words,
)
from me2e_compress.operators.kernels.vectors import (
    LANES,
    Vectors,
    host_tile,
    matrix_product,
    vector_intrinsic,
)

# The transforms, as vector instructions.

# Numbers along one axis of a tile of outputs, a filter, and a tile of inputs
OUT, FILTER, SIDE = 4, 3, 6

PRODUCTS = SIDE * SIDE  # numbers of a transformed tile or filter

_NEAR, _FAR = math.sqrt(0.5), math.sqrt(2)

Numbers: TypeAlias = Sequence[Any]


def _input(w: Vectors, d: Numbers) -> Numbers:
    """Multiply B^T by six vectors."""
    # d4 - d2 / p^2 and d3 - d1 / p^2 for the points p^2 = 1/2 and 2: the rows of p and
    # of -p are their sum and their difference, the odd part times p
    near_even, far_even = w.plus(d[4], -2.0, d[2]), w.plus(d[4], -0.5, d[2])
    near_odd, far_odd = w.plus(d[3], -2.0, d[1]), w.plus(d[3], -0.5, d[1])
    return (
        w.plus(w.add(d[0], d[4]), -2.5, d[2]),
        w.plus(near_even, _NEAR, near_odd),
        w.plus(near_even, -_NEAR, near_odd),
        w.plus(far_even, _FAR, far_odd),
        w.plus(far_even, -_FAR, far_odd),
        w.plus(w.add(d[1], d[5]), -2.5, d[3]),
    )


def _filter(w: Vectors, g: Numbers) -> Numbers:
    """Multiply G by three vectors."""
    # g0 + p g1 + p^2 g2 for p and -p, times a factor of the pair
    near = w.times(-2 / 3, w.plus(g[0], 0.5, g[2]))
    far = w.times(1 / 6, w.plus(g[0], 2.0, g[2]))
    return (
        g[0],
        w.plus(near, -2 / 3 * _NEAR, g[1]),
        w.plus(near, 2 / 3 * _NEAR, g[1]),
        w.plus(far, 1 / 6 * _FAR, g[1]),
        w.plus(far, -1 / 6 * _FAR, g[1]),
        g[2],
    )


def _output(w: Vectors, m: Numbers) -> Numbers:
    """Multiply A^T by six vectors."""
    # Output k is the sum of p^k m(p) over the points: even powers take m(p) + m(-p),
    # odd ones m(p) - m(-p); the first has the point 0 besides, the last infinity
    near, far = w.add(m[1], m[2]), w.add(m[3], m[4])
    near_odd, far_odd = w.subtract(m[1], m[2]), w.subtract(m[3], m[4])
    return (
        w.add(m[0], w.add(near, far)),
        w.plus(w.times(_NEAR, near_odd), _FAR, far_odd),
        w.plus(w.times(0.5, near), 2.0, far),
        w.plus(w.plus(m[5], _NEAR**3, near_odd), _FAR**3, far_odd),
    )


def _input_rows(
    w: Vectors, image: Any, y: Any, high: Any, x: Any, wide: Any, to: Any, row: Any
) -> None:
    builder, read = w.builder, []
    ahead = builder.mul(high, wide)
    for k in range(SIDE):
        # An unsigned comparison: rows above the image are large numbers
        line = builder.add(y, WORD(k))
        inside = builder.icmp_unsigned("<", line, high)
        limit = builder.select(inside, wide, WORD(0))
        place = w.place(image, builder.add(builder.mul(line, wide), x))
        read.append(w.load(place, w.within(x, limit)))
        w.fetch(builder.gep(place, [ahead]))
    for k, vector in enumerate(_input(w, read)):
        w.store(vector, w.place(to, builder.mul(row, WORD(k))))


def _input_columns(
    w: Vectors, rows: Any, row: Any, to: Any, plane: Any, count: Any
) -> None:
    """Multiply B^T d of ``count`` tiles by B; strides ``row``, ``plane`` in numbers."""
    builder, mask = w.builder, w.within(WORD(0), count)
    following = range(1, LANES + 1)  # lanes: all but the first, then that behind
    for k in range(SIDE):
        first = w.place(rows, builder.mul(row, WORD(k)))
        places = [builder.gep(first, [WORD(LANES * part)]) for part in range(OUT + 1)]
        columns = list(w.take_apart([w.load(place) for place in places[:OUT]]))
        # The last two of a tile are the first two of the next
        for part in range(SIDE - OUT):
            after = builder.load(builder.gep(places[OUT], [WORD(part)]))
            columns.append(w.choose(columns[part], w.spread(after), following))
        for part, vector in enumerate(_input(w, columns)):
            at = builder.mul(plane, WORD(k * SIDE + part))
            w.store(vector, w.place(to, at), mask)


def _filters(
    w: Vectors, elements: Any, step: Any, count: Any, to: Any, plane: Any, ahead: Any
) -> None:
    builder, mask, read = w.builder, w.within(WORD(0), count), []
    for k in range(FILTER * FILTER):
        place = w.place(elements, builder.mul(step, WORD(k)))
        read.append(w.load(place, mask))
        w.fetch(builder.gep(place, [ahead]))
    # g G^T by rows, then G (g G^T) by columns
    across = [_filter(w, read[FILTER * k : FILTER * (k + 1)]) for k in range(FILTER)]
    for part in range(SIDE):
        for k, vector in enumerate(_filter(w, [line[part] for line in across])):
            at = builder.mul(plane, WORD(k * SIDE + part))
            w.store(vector, w.place(to, at))


def _outputs(
    w: Vectors,
    m: Any, plane: Any, bias: Any,
    to: Any, wide: Any, rows: Any, count: Any, ahead: Any,
) -> None:  # fmt: skip
    builder = w.builder
    both = [w.spread(builder.load(w.place(bias, WORD(k)))) for k in range(2)]
    across = []  # A^T m, by columns
    for column in range(SIDE):
        parts = (WORD(k * SIDE + column) for k in range(SIDE))
        places = [w.place(m, builder.mul(plane, part)) for part in parts]
        across.append(_output(w, [w.load(place) for place in places]))
    for k in range(OUT):
        # Row k of A^T m A, plus the bias, and at least the least number
        row = _output(w, [column[k] for column in across])
        row = [w.at_least(w.add(vector, both[0]), both[1]) for vector in row]
        # Rows below the image have no lanes
        inside = builder.icmp_signed("<", WORD(k), rows)
        limit = builder.select(inside, count, WORD(0))
        for part, vector in enumerate(w.put_together(row)):
            first = WORD(part * LANES)
            place = w.place(to, builder.add(builder.mul(wide, WORD(k)), first))
            w.store(vector, place, w.within(first, limit))
            w.fetch(builder.gep(place, [ahead]))


# `((image, y, high, x, wide, to, row))`: multiply B^T by 16 columns of an image.
# `image` is the address of one channel [high, wide]; six of its rows from y, and 16
# columns from x, are read, zeros where they lie outside. The six results are written
# `row` numbers from each other. The same place of the next channel is fetched ahead: no
# processor foresees the leap, and this transform would wait for memory (VAD-tiny's
# layers of 64 channels took 18 ms, of which 6 for this, and now 12).
input_rows = vector_intrinsic(_input_rows)

# `((rows, row, to, plane, count))`: multiply up to 16 tiles by B. `rows` are results of
# `input_rows`, those of tile t from column 4 t on; the 36 numbers of a tile are written
# `plane` numbers from each other, tile beside tile.
input_columns = vector_intrinsic(_input_columns)

# `((elements, step, count, to, plane, ahead))`: write G g G^T of up to 16 filters. The
# nine elements of filters are `step` numbers from each other, filter beside filter; the
# 36 results `plane` numbers. Those of filters beyond `count` are zeros. The elements
# `ahead` numbers behind these are fetched.
filters = vector_intrinsic(_filters)

# `((m, plane, bias, to, wide, rows, count, ahead))`: write A^T m A of 16 tiles. The 36
# numbers of a tile are `plane` numbers from each other. To the results, the number at
# `bias` is added, and they are at least the second number there. Of the 4 rows of
# results, `wide` numbers from each other, `rows` are written, and of their 64 columns
# `count`. The place `ahead` numbers behind is fetched.
outputs = vector_intrinsic(_outputs)


# Filters of a panel, inputs and outputs of a block.

TILES = 48  # tiles per block

# Output channels per group. Their products with a block, 442 kB, and the transformed
# inputs of 64 channels fit into a second cache of 1 MB.
GROUP = 64

PANELS = GROUP // LANES

AHEAD = 4  # channels by which filters are fetched ahead

ROW = OUT * TILES + LANES  # columns of one row of input tiles of a block

# Numbers from one of the 36 products to the next, a vector more than needed here and
# below: planes of a multiple of 4 kB would all share the same sets of the first cache
PRODUCT_PLANE = GROUP * TILES + LANES

# words of one call
X, FILTERS, BIAS, OPTIONS, Y = range(5)
N, C, H, W, K, TOP, LEFT, HIGH, WIDE, DOWN, ACROSS = range(5, 16)
RELU = 4  # the index of the flag among the options, behind the pads

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
    depth, wide, count = a[C], a[K], a[K] - panel * LANES
    for c in range(depth):
        elements = a[FILTERS] + (c * wide + panel * LANES) * 4
        at = to + c * LANES * 4
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
            sizes = (1, LANES, TILES, TILES, LANES, TILES, depth, 0)
            _multiply((left, right, at, *sizes))


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


STRIPS = 16  # threads that can work at once: each has memory of its own

# words of one call, behind those of winograd_blocks
BLOCKS, SHARED, OWN, STRIDE, BY_BLOCK, FIRST_STAGE, PARTS = range(16, 23)
WORDS = 23

RANKS = (4, 4, 1, 1)
RANK_WRONG, SIZE_WRONG = range(2)
NUMBERS = 5  # numbers of the options: four pads, and whether negative results become 0

_words = stack(types.int64, WORDS)
_inputs = stack(types.int64, EACH * len(RANKS))
_memory = stack(types.int64, 3)


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
    # Multiply it with all that is shared: 36 products [wide, C] [C, TILES]
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
    panels, memory = part(a[K], LANES), _memory()
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
    status = allocate_memory(t, context, shared + a[PARTS] * a[STRIDE], memory)
    if status != 0:
        return status
    a[SHARED], a[OWN] = memory[0], memory[0] + shared
    # Run
    run, code, user = t[abi.PARALLEL_FOR], t[abi.BLOCK], address_of(a)
    a[FIRST_STAGE] = 1
    status = call(run, context, code, panels if a[BY_BLOCK] else a[C], 0, user)
    a[FIRST_STAGE] = 0
    if status == 0:
        status = call(run, context, code, a[PARTS], 0, user)
    free_memory(t, memory)
    return status


def _compute(state: int, context: int) -> Word:
    t, x, a = words(state), _inputs(), _words()
    # Read the inputs
    for i in range(len(RANKS)):
        rank = read_input(t, context, i, address_of(x) + 8 * EACH * i)
        if rank != RANKS[i]:
            return error_status(t, RANK_WRONG)
        a[i] = x[EACH * i + ADDRESS]
    misfit = _sizes(a, x)
    if misfit >= 0:
        return error_status(t, misfit)
    # Create the output
    x[0], x[1], x[2], x[3] = a[N], a[K], a[HIGH], a[WIDE]
    status = create_output(t, context, x, 4, address_of(a) + 8 * Y)
    if status != 0 or a[BLOCKS] * a[K] == 0:
        return status
    return _run(t, context, a)


def functions(op_type: str) -> Mapping[str, Callable[[int, int], Word]]:
    """Return the functions to compile for the operator."""
    return {"compute": _compute, "block": _block}
