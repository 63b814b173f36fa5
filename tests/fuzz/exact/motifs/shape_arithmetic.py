"""Shapes that are computed: the arithmetic that exporters leave in a graph."""

import numpy as np
from onnx.numpy_helper import from_array

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import Builder
from tests.fuzz.exact.values import BOOL, INT64, Dim, Val, is_static, product, sizes


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
                two = [_dim(b, x, at), _dim(b, x, at + 1)]
                both = b.op("Mul", two, ())
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
