"""The transforms of Winograd's convolution F(4x4, 3x3), as vector instructions.

Y = A^T [(G g G^T) * (B^T d B)] A (Lavin and Gray, arXiv 1509.09308, equation 8), with
the matrices of Cook and Toom for the points 0, +-sqrt(1/2), +-sqrt(2) and infinity:
their rounding error in float32 is half of that of 0, +-1, +-2, infinity (6 dB measured,
see Barabasz et al., arXiv 1803.10986, on the choice of points). A point and its
negative share their even and odd parts. Every lane of a vector is one tile, but for
the filters, where it is one output channel.
"""

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

from me2e_compress.operators.kernels.intrinsics import WORD
from me2e_compress.operators.kernels.vectors import LANES, Vectors, vector_intrinsic

OUT, FILTER, SIDE = 4, 3, 6
"""Numbers along one axis of a tile of outputs, a filter, and a tile of inputs."""

PRODUCTS = SIDE * SIDE
"""Numbers of a transformed tile or filter."""

_NEAR, _FAR = math.sqrt(0.5), math.sqrt(2)

Numbers: TypeAlias = Sequence[Any]


def _input(w: Vectors, d: Numbers) -> Numbers:
    """Multiply B^T by six vectors."""
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
    builder, mask = w.builder, w.within(WORD(0), count)
    for k in range(SIDE):
        first = w.place(rows, builder.mul(row, WORD(k)))
        places = [builder.gep(first, [WORD(LANES * part)]) for part in range(OUT + 1)]
        taken = list(w.take_apart([w.load(place) for place in places[:OUT]]))
        # The last two of a tile are the first two of the next
        for part in range(SIDE - OUT):
            after = builder.load(builder.gep(places[OUT], [WORD(part)]))
            following = range(1, LANES + 1)
            taken.append(w.choose(taken[part], w.spread(after), following))
        for part, vector in enumerate(_input(w, taken)):
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
    across = []
    for part in range(SIDE):
        parts = (WORD(k * SIDE + part) for k in range(SIDE))
        places = [w.place(m, builder.mul(plane, each)) for each in parts]
        across.append(_output(w, [w.load(place) for place in places]))
    for k in range(OUT):
        made = [w.add(each, both[0]) for each in _output(w, [col[k] for col in across])]
        made = [w.at_least(each, both[1]) for each in made]
        # Rows below the image have no lanes
        inside = builder.icmp_signed("<", WORD(k), rows)
        limit = builder.select(inside, count, WORD(0))
        for part, vector in enumerate(w.put_together(made)):
            first = WORD(part * LANES)
            place = w.place(to, builder.add(builder.mul(wide, WORD(k)), first))
            w.store(vector, place, w.within(first, limit))
            w.fetch(builder.gep(place, [ahead]))


input_rows = vector_intrinsic(_input_rows)
"""``((image, y, high, x, wide, to, row))``: multiply B^T by 16 columns of an image.

``image`` is the address of one channel [high, wide]; six of its rows from y, and 16
columns from x, are read, zeros where they lie outside. The six results are written
``row`` numbers from each other. The same place of the next channel is fetched ahead:
no processor foresees the leap, and this transform would wait for memory (VAD-tiny's
layers of 64 channels took 18 ms, of which 6 for this, and now 12).
"""

input_columns = vector_intrinsic(_input_columns)
"""``((rows, row, to, plane, count))``: multiply up to 16 tiles by B.

``rows`` are results of :data:`input_rows`, those of tile t from column 4 t on; the 36
numbers of a tile are written ``plane`` numbers from each other, tile beside tile.
"""

filters = vector_intrinsic(_filters)
"""``((elements, step, count, to, plane, ahead))``: write G g G^T of up to 16 filters.

The nine elements of filters are ``step`` numbers from each other, filter beside filter;
the 36 results ``plane`` numbers. Those of filters beyond ``count`` are zeros. The
elements ``ahead`` numbers behind these are fetched.
"""

outputs = vector_intrinsic(_outputs)
"""``((m, plane, bias, to, wide, rows, count, ahead))``: write A^T m A of 16 tiles.

The 36 numbers of a tile are ``plane`` numbers from each other. To the results, the
number at ``bias`` is added, and they are at least the second number there. Of the 4
rows of results, ``wide`` numbers from each other, ``rows`` are written, and of their
64 columns ``count``. The place ``ahead`` numbers behind is fetched.
"""
