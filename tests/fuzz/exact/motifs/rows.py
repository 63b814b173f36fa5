"""Rows that are repeated, moved and viewed; and shapes that are computed."""

from collections.abc import Callable

import numpy as np
from onnx.numpy_helper import from_array

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import (
    BOOL,
    INT64,
    Builder,
    Dim,
    Open,
    Val,
    elements,
    is_static,
    product,
    sizes,
)
from tests.fuzz.exact.motifs.layers import layer

LARGEST = 1 << 15
"""Elements that a repetition may make."""


def _count(b: Builder, x: Val) -> int:
    most = max(1, LARGEST // max(1, elements(x.shape)))
    return min(most, b.rng.choice((1, 2, 3, 5, 16, 64, 128)))


def _tiled(b: Builder, x: Val) -> Val:
    repeats = [1] * x.rank
    axes = [axis for axis in range(x.rank - 1) if isinstance(x.shape[axis], int)]
    if axes:
        repeats[b.rng.choice(axes)] = _count(b, x)
    if b.chance(0.15):
        repeats[-1] = b.rng.choice((1, 2))
    return sp.tile(b, x, repeats)


def _expanded(b: Builder, x: Val) -> Val:
    axes = [axis for axis in range(x.rank) if x.shape[axis] == 1]
    target = [1] * x.rank
    if axes and b.chance(0.7):
        target[b.rng.choice(axes)] = _count(b, x)
    if is_static(x.shape) and b.chance(0.5):
        target = [max(a, c) for a, c in zip(target, sizes(x.shape), strict=True)]
    if b.chance(0.4):
        target = [_count(b, x), *target]
    return sp.expand(b, x, target)


def _unsqueezed(b: Builder, x: Val) -> Val:
    """Write Unsqueeze, Expand and a view that drops or joins the new axis."""
    axis = b.rng.randint(0, max(x.rank - 1, 0))
    count = _count(b, x)
    wide = sp.unsqueeze(b, x, axis)
    target = [1] * wide.rank
    target[axis] = count
    if is_static(wide.shape) and b.chance(0.5):
        target = list(sizes(wide.shape))
        target[axis] = count
    many = sp.expand(b, wide, target) if b.chance(0.7) else sp.tile(b, wide, target)
    return _viewed(b, many)


def _viewed(b: Builder, x: Val) -> Val:
    """Change the rank by a Reshape, Flatten, Squeeze or Unsqueeze."""
    views: list[Callable[[], Val]] = [lambda: x]
    opened = sum(isinstance(dim, Open) for dim in x.shape)
    if x.rank >= 2 and opened <= 1:
        at = b.rng.randint(0, x.rank - 2)
        both = product(x.shape[at : at + 2])
        joined: list[Dim] = [*x.shape[:at], both, *x.shape[at + 2 :]]
        views.append(lambda: sp.reshape(b, x, joined))
        views.append(lambda: sp.flatten(b, x, x.rank - 1))
    ones = [axis for axis, dim in enumerate(x.shape) if dim == 1]
    if ones and x.rank > 1:
        views.append(lambda: sp.squeeze(b, x, b.rng.choice(ones)))
    if x.rank < 5:
        views.append(lambda: sp.unsqueeze(b, x, b.rng.randint(0, x.rank)))
    return b.rng.choice(views)()


def _stacked(b: Builder, x: Val) -> Val:
    axes = [axis for axis in range(x.rank) if isinstance(x.shape[axis], int)]
    if not axes:
        return x
    parts = [x] * b.rng.choice((1, 2, 3, 6))
    if b.chance(0.2):
        parts[-1] = sp.unary(b, x)
    return sp.concat(b, parts, b.rng.choice(axes))


def _gathered(b: Builder, x: Val) -> Val:
    known = [(axis, n) for axis, n in enumerate(x.shape) if isinstance(n, int)]
    axis, size = b.rng.choice(known) if known else (0, 0)
    if not size:
        return x
    shape = b.rng.choice(((), (1,), (7,), (40,), (2, 3)))
    low = -size if b.chance(0.3) else 0
    indices = np.asarray(b.draws.integers(low, size, shape), np.int64)
    return sp.gather(b, x, b.const(indices), axis)


def _gathered_nd(b: Builder, x: Val) -> Val:
    first = x.shape[0]
    if not isinstance(first, int) or not first or x.rank < 2:
        return x
    count = b.rng.choice((1, 5, 30))
    indices = np.asarray(b.draws.integers(0, first, (count, 1)), np.int64)
    return b.op("GatherND", [x, b.const(indices)], (count, *x.shape[1:]))


def _sliced(b: Builder, x: Val) -> Val:
    known = [(axis, n) for axis, n in enumerate(x.shape) if isinstance(n, int) and n]
    if not known:
        return x
    axis, size = b.rng.choice(known)
    start = b.rng.randint(0, size - 1)
    return sp.slice_(b, x, axis, start, b.rng.randint(start + 1, size))


def _turned(b: Builder, x: Val) -> Val:
    order = list(range(x.rank - 1))
    b.rng.shuffle(order)
    order.append(x.rank - 1)
    if b.chance(0.2):
        b.rng.shuffle(order)
    return sp.transpose(b, x, order)


REPEATS = (_tiled, _expanded, _unsqueezed, _stacked, _gathered, _gathered_nd)
MOVES = (_viewed, _viewed, _sliced, _turned)


def operand(b: Builder, x: Val) -> Val:
    """Make a constant that is broadcast to a value: of any rank up to its own."""
    shape = [dim if isinstance(dim, int) else 1 for dim in x.shape]
    kept = shape[b.rng.randint(0, x.rank) :]
    thin = [1 if b.chance(0.4) else size for size in kept]
    array = b.uniform(0.5, 2, thin) * b.draws.choice((-1, 1), thin)
    if b.chance(0.05):
        array = np.where(b.draws.random(thin) < 0.3, -0.0, array)
    return b.const(np.asarray(array, b.dtype))


def row_wise(b: Builder, x: Val) -> Val:
    """Do something to every row alike, or nearly so: axes vary."""
    kind = b.rng.random()
    axis = b.rng.choice((-1, -1, -1, b.rng.randint(0, x.rank - 1)))
    if kind < 0.25:
        return sp.unary(b, x)
    if kind < 0.5:
        other = operand(b, x)
        name = b.rng.choice(("Add", "Sub", "Mul", "Div", "Max", "Min"))
        if name == "Div" and not np.all(other.array):
            name = "Mul"
        return sp.either_way(b, name, x, other)
    if kind < 0.65:
        name = b.rng.choice(("Softmax", "Softmax", "LogSoftmax"))
        if b.chance(0.2) and b.opset >= 13:
            return b.op(name, [x], x.shape)
        return sp.softmax(b, x, axis, name)
    if kind < 0.75 and b.opset >= 17:
        return _layer_norm(b, x, axis)
    if kind < 0.9:
        names = ("ReduceSum", "ReduceMean", "ReduceMax", "ReduceMin", "ReduceL2")
        name = b.rng.choice(names)
        axes = [axis]
        if b.chance(0.2):
            axes = sorted({axis % x.rank, b.rng.randint(0, x.rank - 1)})
        keep = x.rank <= len(axes) or b.chance(0.6)
        return sp.reduce(b, name, x, axes, keep=keep)
    return layer(b, x) if x.rank >= 2 and x.is_rows() else sp.unary(b, x)


def _layer_norm(b: Builder, x: Val, axis: int) -> Val:
    at = axis % x.rank
    if not is_static(x.shape[at:]) or not elements(x.shape[at:]):
        return sp.unary(b, x)
    shape = sizes(x.shape[at:])
    inputs = [x, b.weight(shape, 1)]
    if b.chance(0.7):
        inputs.append(b.weight(shape, 0.5))
    given = at if b.chance(0.5) else at - x.rank
    attributes = {} if given == -1 and b.chance(0.5) else {"axis": given}
    return b.op("LayerNormalization", inputs, x.shape, attributes)


def repeated_rows(b: Builder) -> None:
    """Repeat rows, move them, then do things to each of them."""
    x = b.rows(1, 3) if b.chance(0.2) else b.rows(2, 3)
    for _ in range(b.rng.randint(1, 2)):
        if elements(x.shape) < LARGEST // 2:
            x = b.rng.choice(REPEATS)(b, x)
        if x.rank and b.chance(0.6):
            x = b.rng.choice(MOVES)(b, x)
    for _ in range(b.rng.randint(1, 4)):
        if not 1 <= x.rank <= 6 or elements(x.shape) > 2 * LARGEST:
            return
        x = row_wise(b, x)
        if b.chance(0.2) and x.rank:
            x = b.rng.choice(MOVES)(b, x)


def gathered_batches(b: Builder) -> None:
    """GatherND within each batch, then a layer or a norm on what it chose."""
    if b.opset < 12:
        return
    batch, count, width = b.rng.randint(1, 4), b.rng.choice((3, 30)), 8
    x = b.input((batch, 5, width))
    chosen = np.asarray(b.draws.integers(0, 5, (batch, count, 1)), np.int64)
    y = b.op("GatherND", [x, b.const(chosen)], (batch, count, width), {"batch_dims": 1})
    y = sp.at_times(b, 0.5, y)
    layer(b, y, 16)


def repeated_layer(b: Builder) -> None:
    """Repeat rows so often that a layer pays more in front of the repetition."""
    x = b.rows(2, 3)
    if not is_static(x.shape) or elements(x.shape) > 1024:
        x = b.input((1, b.rng.randint(1, 4), b.rng.choice((8, 16))))
    axis = b.rng.randint(0, x.rank - 2)
    wide = sp.unsqueeze(b, x, axis) if b.chance(0.5) else x
    repeats = [1] * wide.rank
    repeats[axis] = max(1, min(256, LARGEST // max(1, elements(x.shape))))
    many = sp.tile(b, wide, repeats)
    if wide.shape[axis] == 1 and b.chance(0.5):
        many = sp.expand(b, wide, repeats)
    if b.chance(0.6):
        many = _viewed(b, many)
    if b.chance(0.4) and many.rank >= 2:
        many = row_wise(b, many)
    if many.rank >= 2 and many.is_rows():
        layer(b, many, 16)


def _dim(b: Builder, x: Val, axis: int, *, flat: bool = False) -> Val:
    """Read one size of a value, as a scalar or as a vector of one."""
    shape = sp.shape_of(b, x)
    given = axis - x.rank if b.chance(0.3) else axis
    if flat and b.chance(0.3):
        return sp.slice_(b, shape, 0, axis, axis + 1)
    index = b.const(np.asarray(given, np.int64))
    scalar = b.op("Gather", [shape, index], (), {"axis": 0})
    if b.chance(0.2):
        scalar = _cast_twice(b, scalar)
    return sp.unsqueeze(b, scalar, 0) if flat else scalar


def _cast_twice(b: Builder, x: Val) -> Val:
    """Cast to float and back, as a scale factor of 1 leaves it."""
    wide = b.op("Cast", [x], x.shape, {"to": 1}, dtype=np.dtype(np.float32))
    one = b.const(np.float32(1))
    scaled = b.op("Mul", [wide, one], x.shape)
    whole = b.op("Floor", [scaled], x.shape)
    return b.op("Cast", [whole], x.shape, {"to": 7}, dtype=INT64)


def computed_reshape(b: Builder) -> None:
    """Join or keep axes by a shape that is computed from the value's own."""
    x = b.rows(2, 4)
    parts: list[Val] = []
    dims: list[Dim] = []
    at = b.rng.randint(0, x.rank - 2)
    for axis in range(x.rank):
        if axis == at + 1:
            continue
        if axis == at:
            dims.append(product(x.shape[at : at + 2]))
            if b.chance(0.5):
                parts.append(b.ints(-1))
            else:
                both = b.op("Mul", [_dim(b, x, at), _dim(b, x, at + 1)], ())
                parts.append(sp.unsqueeze(b, both, 0))
        else:
            dims.append(x.shape[axis])
            known = x.shape[axis]
            if isinstance(known, int) and b.chance(0.3):
                parts.append(b.ints(known))
            else:
                parts.append(_dim(b, x, axis, flat=True))
    shape = b.op("Concat", parts, (len(parts),), {"axis": 0})
    made = b.op("Reshape", [x, shape], dims)
    sp.at_times(b, 0.5, made)


def filled(b: Builder) -> None:
    """A constant of a computed shape, added to the value."""
    x = b.rows(1, 4)
    shape = sp.shape_of(b, x)
    number = b.rng.choice((0.0, 1.0, 2.5))
    if b.chance(0.3):
        made = sp.binary(b, "Mul", x, sp.scalar(b, 0.0, 0))
    else:
        attributes = {"value": from_array(np.full(1, number, b.dtype))}
        made = b.op("ConstantOfShape", [shape], x.shape, attributes, dtype=b.dtype)
    sp.binary(b, b.rng.choice(("Add", "Mul", "Max")), x, made)


def counted(b: Builder) -> None:
    """Positions by Range, cast, scaled and added to the last axis but one."""
    x = b.rows(2, 3)
    axis = b.rng.choice((x.rank - 1, x.rank - 2))
    start, step = (b.const(np.asarray(each, np.int64)) for each in (0, 1))
    limit = _dim(b, x, axis)
    steps = b.op("Range", [start, limit, step], (x.shape[axis],), dtype=INT64)
    to = 11 if b.is_double else 1
    wide = b.op("Cast", [steps], steps.shape, {"to": to}, dtype=b.dtype)
    scaled = sp.binary(b, "Mul", wide, sp.scalar(b, 0.1, 0))
    if axis == x.rank - 2:
        scaled = sp.unsqueeze(b, scaled, 1)
    sp.binary(b, b.rng.choice(("Add", "Mul")), x, scaled)


def expanded_by_shape(b: Builder) -> None:
    """Expand to a shape that Where picks -1 out of, as torch exports it."""
    x = b.rows(2, 3)
    if not is_static(x.shape):
        y = b.input([1] * (x.rank - 1) + [x.width])
        b.op("Expand", [y, sp.shape_of(b, x)], x.shape)
        return
    count = b.rng.choice((1, 2, 4))
    wanted = b.ints(count, *([-1] * x.rank))
    length = b.ints(x.rank + 1)
    attributes = {"value": from_array(np.ones(1, np.int64))}
    ones = b.op("ConstantOfShape", [length], (x.rank + 1,), attributes, dtype=INT64)
    minus = b.op("Mul", [ones, b.const(np.asarray(-1, np.int64))], ones.shape)
    same = b.op("Equal", [wanted, minus], ones.shape, dtype=BOOL)
    shape = b.op("Where", [same, ones, wanted], ones.shape, dtype=INT64)
    made = b.op("Expand", [x, shape], (count, *sizes(x.shape)))
    sp.at_times(b, 0.6, made)


def sliced_by_shape(b: Builder) -> None:
    """Cut half of an axis off, where the half is computed."""
    x = b.rows(2, 3)
    axis = x.rank - 1
    half = b.op("Div", [_dim(b, x, axis), b.const(np.asarray(2, np.int64))], ())
    end = sp.unsqueeze(b, half, 0)
    given = [x, b.ints(0), end, b.ints(axis)]
    first = b.op("Slice", given, (*x.shape[:-1], x.width // 2))
    given = [x, end, b.ints(np.iinfo(np.int64).max), b.ints(axis)]
    rest = b.op("Slice", given, (*x.shape[:-1], x.width - x.width // 2))
    sp.concat(b, [rest, first], axis)


def given_back(b: Builder) -> None:
    """A shape or a size as an output of its own."""
    x = b.rows(1, 4)
    shape = sp.shape_of(b, x)
    if b.chance(0.5):
        b.op("Size", [x], (), dtype=INT64)
    else:
        b.op("ReduceProd", [shape], (1,), dtype=INT64)
