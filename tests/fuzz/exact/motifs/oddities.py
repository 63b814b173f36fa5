"""What ONNX allows and passes forget: twins, views, odd constants, rare spellings."""

import math

import numpy as np

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import BOOL, INT64, Builder, is_static, sizes


def no_ops(b: Builder) -> None:
    """Identity, Dropout, casts to the same type, a Pad of nothing, a full slice."""
    x = b.rows(1, 4)
    for _ in range(b.rng.randint(1, 3)):
        kind = b.rng.randint(0, 6)
        if kind == 0:
            x = b.op("Identity", [x], x.shape)
        elif kind == 1:
            more = [] if b.chance(0.5) or b.opset < 12 else [b.const(np.float32(0.5))]
            x = b.op("Dropout", [x, *more], x.shape)
        elif kind == 2:
            to = 11 if b.is_double else 1
            x = b.op("Cast", [x], x.shape, {"to": to})
        elif kind == 3:
            x = sp.slice_(b, x, x.rank - 1, 0, x.width)
        elif kind == 4:
            x = sp.reshape(b, x, x.shape)
        elif kind == 5:
            x = sp.transpose(b, x, range(x.rank))
        else:
            x = sp.concat(b, [x], x.rank - 1)
    sp.at_times(b, 0.6, x)


def pairs(b: Builder) -> None:
    """Transposes and views in a row, which cancel or merge."""
    x = b.rows(2, 4)
    for _ in range(b.rng.randint(2, 4)):
        kind = b.rng.random()
        if kind < 0.5:
            order = list(range(x.rank))
            b.rng.shuffle(order)
            x = sp.transpose(b, x, order)
        elif kind < 0.7:
            flat = sp.flatten(b, x, b.rng.randint(0, x.rank))
            x = sp.reshape(b, flat, x.shape) if b.chance(0.6) else flat
        elif x.rank < 5:
            x = sp.unsqueeze(b, x, b.rng.randint(0, x.rank))
        sp.at_times(b, 0.15, x)
    ones = [axis for axis, dim in enumerate(x.shape) if dim == 1]
    if ones and b.chance(0.6):
        sp.squeeze(b, x, b.rng.choice(ones))


def twins(b: Builder) -> None:
    """Equal subexpressions, their operands swapped at times."""
    x = b.rows(2, 4)
    number = b.normal((x.width,))
    made = []
    for _ in range(b.rng.randint(2, 3)):
        other = b.const(number)
        y = sp.either_way(b, b.rng.choice(("Add", "Mul", "Max", "Sub")), x, other)
        made.append(b.op("Tanh", [y], y.shape) if b.chance(0.7) else y)
    if b.chance(0.6):
        sp.binary(b, "Sub", made[0], made[1])


def empty_inputs(b: Builder) -> None:
    """Optional inputs that are left out in the middle."""
    x = b.rows(1, 4)
    low, high = b.rng.choice(((None, 0.7), (-0.7, None), (None, None), (-0.5, 0.5)))
    y = sp.clip(b, x, low, high)
    if b.chance(0.5):
        y = sp.clip(b, y, b.rng.choice((None, -0.2)), b.rng.choice((None, 0.9)))
    sp.unary(b, y)


def odd_constants(b: Builder) -> None:
    """Zeros of both signs, infinities and NaN, where they do not reach far."""
    x = b.rows(1, 3)
    kind = b.rng.randint(0, 4)
    if kind == 0:
        zero = sp.scalar(b, b.rng.choice((0.0, -0.0)))
        if zero.rank <= x.rank:
            y = sp.binary(b, b.rng.choice(("Add", "Sub", "Mul")), x, zero)
            inverse = b.op("Reciprocal", [y], y.shape) if b.chance(0.3) else y
            b.hide(inverse)
    elif kind == 1:
        bound = sp.scalar(b, b.rng.choice((math.inf, -math.inf)), 0)
        y = sp.binary(b, b.rng.choice(("Min", "Max")), x, bound)
        b.op("Tanh", [b.hide(y)], y.shape)
    elif kind == 2:
        chosen = b.const(np.asarray(b.draws.random((x.width,)) < 0.8))
        other = sp.scalar(b, b.rng.choice((math.nan, math.inf, 0.0)), 0)
        y = b.op("Where", [chosen, x, other], x.shape, dtype=b.dtype)
        if not np.all(np.isfinite(other.array if other.array is not None else 0)):
            sp.unary(b, b.hide(y), "Neg")
            b.hide(b.values[-1])
    elif kind == 3:
        one = b.const(np.full((1,) * b.rng.randint(1, 3), 2.0, b.dtype))
        turned = sp.transpose(b, one, range(one.rank))
        if one.rank <= x.rank:
            y = sp.binary(b, b.rng.choice(("Mul", "Div")), x, turned)
            if y.rank >= 2:
                sp.matmul(b, y, b.weight((x.width, 4)))
    else:
        least = b.op("Greater", [x, sp.scalar(b, 0.0, 0)], x.shape, dtype=BOOL)
        other = sp.binary(b, "Mul", x, sp.scalar(b, 0.1, 0))
        b.op("Where", [least, x, other], x.shape, dtype=b.dtype)


def branches(b: Builder) -> None:
    """A split whose parts are joined in another order, or one of them unread."""
    x = b.rows(2, 4)
    cut = b.rng.randint(1, x.width - 1)
    first, second = sp.split(b, x, x.rank - 1, [cut, x.width - cut])
    first = sp.at_times(b, 0.3, first)
    if b.chance(0.7):
        sp.concat(b, [second, first] if b.chance(0.5) else [first, second], x.rank - 1)


def grown_by_a_constant(b: Builder) -> None:
    """A constant with more axes, or larger ones, than the value it is added to."""
    x = b.rows(1, 3)
    shape = [1 if b.chance(0.5) else d for d in x.shape if isinstance(d, int)]
    if len(shape) < x.rank:
        shape = [1] * x.rank
    ones = [axis for axis, dim in enumerate(x.shape) if dim == 1]
    if ones and b.chance(0.5):
        shape[b.rng.choice(ones)] = 3
    else:
        shape = [b.rng.choice((1, 2)), *shape]
    for _ in range(b.rng.randint(1, 2)):
        other = b.const(b.uniform(0.5, 2, shape))
        x = sp.binary(b, b.rng.choice(("Add", "Mul", "Sub", "Div")), x, other)
    if x.rank >= 2 and b.chance(0.5):
        sp.matmul(b, x, b.weight((x.width, 4)))


def odd_products(b: Builder) -> None:
    """Products by a vector, by a batch of matrices, of a value with itself."""
    x = b.rows(2, 3)
    kind = b.rng.randint(0, 4)
    if kind == 0:
        y = b.op("MatMul", [x, b.weight((x.width,))], x.shape[:-1])
    elif kind == 1:
        lead = b.rng.choice(((1,), (2, 1), (1, 1, 1)))
        y = sp.matmul(b, x, b.weight((*lead, x.width, 6)))
        if b.chance(0.6):
            y = sp.binary(b, "Mul", y, sp.scalar(b, 0.5, 1))
    elif kind == 2:
        turned = sp.transpose(b, x, [*range(x.rank - 2), x.rank - 1, x.rank - 2])
        if isinstance(x.shape[-2], int):
            sp.matmul(b, x, turned)
        return
    elif kind == 3 and x.rank == 2 and is_static(x.shape):
        rows = sizes(x.shape)[0]
        inputs = [x, b.weight((rows, 5)), b.weight((x.width, 1))]
        y = b.op("Gemm", inputs, (x.width, 5), {"transA": 1})
    else:
        y = sp.binary(b, b.rng.choice(("Add", "Mul", "Sub", "Max")), x, x)
    sp.unary(b, y)


def full_bias(b: Builder) -> None:
    """A Gemm whose bias is a column, or differs for every row."""
    x = b.rows(2, 2)
    rows = x.shape[0]
    shapes: list[tuple[int, ...]] = [(1, 1), (1,)]
    if isinstance(rows, int):
        shapes += [(rows, 1), (rows, 6)]
    inputs = [x, b.weight((x.width, 6)), b.weight(b.rng.choice(shapes), 1)]
    y = b.op("Gemm", inputs, (rows, 6), {"beta": 0.5} if b.chance(0.3) else {})
    other = b.const(b.uniform(0.5, 2, b.rng.choice(((6,), (1, 6), (1,), ()))))
    y = sp.binary(b, b.rng.choice(("Mul", "Add", "Div", "Sub")), y, other)
    if b.chance(0.4):
        sp.matmul(b, y, b.weight((6, 3)))


def cast_about(b: Builder) -> None:
    """A value that becomes float64, or whole, and what it was again."""
    x = b.rows(1, 3)
    here = 11 if b.is_double else 1
    if b.chance(0.6):
        there, kind = (1, np.float32) if b.is_double else (11, np.float64)
        y = b.op("Cast", [x], x.shape, {"to": there}, dtype=np.dtype(kind))
        other = b.const(np.full((), 1.5, kind))
        y = b.op(b.rng.choice(("Mul", "Add")), [y, other], x.shape)
        if b.chance(0.5):
            y = b.op("Tanh", [y], y.shape)
        b.op("Cast", [y], y.shape, {"to": here}, dtype=b.dtype)
    else:
        y = b.op("Cast", [x], x.shape, {"to": 7}, dtype=INT64)
        y = b.op("Add", [y, b.ints(1)], y.shape)
        y = b.op("Cast", [y], y.shape, {"to": here}, dtype=b.dtype)
        sp.binary(b, "Mul", y, sp.scalar(b, 0.5, 0))


def defaults(b: Builder) -> None:
    """Attributes left out: of Transpose, Squeeze, Softmax, Flatten, Concat of one."""
    x = b.rows(2, 3)
    kind = b.rng.randint(0, 3)
    if kind == 0:
        y = b.op("Transpose", [x], tuple(reversed(x.shape)))
        y = b.op("Transpose", [y], x.shape)
    elif kind == 1:
        wide = sp.unsqueeze(b, sp.unsqueeze(b, x, 0), 0)
        if 1 not in x.shape and is_static(x.shape):
            y = b.op("Squeeze", [wide], x.shape)
        else:
            y = sp.squeeze(b, sp.squeeze(b, wide, 0), 0)
    elif kind == 2:
        y = b.op(b.rng.choice(("Softmax", "LogSoftmax")), [x], x.shape)
    else:
        y = b.op("Sum", [x] * b.rng.randint(1, 3), x.shape)
        y = b.op(b.rng.choice(("Max", "Min")), [y], x.shape)
    sp.unary(b, y)
