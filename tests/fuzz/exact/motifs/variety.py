"""Spellings that are rarer: other ranks, defaults left out, several axes, casts."""

import numpy as np

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import Builder
from tests.fuzz.exact.dims import Dim, is_static, sizes
from tests.fuzz.exact.values import INT64, Val

END = int(np.iinfo(np.int64).max)


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


def reduced(b: Builder) -> None:
    """Reductions over all axes, over several, and over none."""
    x = b.rows(2, 4)
    kind = b.rng.choice(("ReduceSum", "ReduceMean", "ReduceMax", "ReduceL1"))
    keep = b.rng.randint(0, 1)
    if b.chance(0.4):
        shape: tuple[Dim, ...] = (1,) * x.rank if keep else ()
        y = b.op(kind, [x], shape, {"keepdims": keep})
    elif b.chance(0.3) and b.opset >= 18:
        empty = b.const(np.zeros(0, np.int64))
        y = b.op(kind, [x, empty], x.shape, {"noop_with_empty_axes": 1})
    else:
        axes = sorted(b.rng.sample(range(x.rank), 2))
        y = sp.reduce(b, kind, x, axes, keep=bool(keep))
    sp.binary(b, "Mul", y, sp.scalar(b, 2.0, 0))


def cut(b: Builder) -> None:
    """Slices backwards, to beyond the end, and along several axes."""
    x = b.rows(2, 3)
    kind = b.rng.randint(0, 2)
    last = x.rank - 1
    if kind == 0:
        given = [x, b.ints(-1), b.ints(-END), b.ints(last), b.ints(-1)]
        y = b.op("Slice", given, x.shape)
    elif kind == 1:
        given = [x, b.ints(-2), b.ints(END), b.ints(-1)]
        y = b.op("Slice", given, (*x.shape[:-1], 2))
    else:
        width = (x.width + 1) // 2
        given = [x, b.ints(0), b.ints(END), b.ints(last), b.ints(2)]
        y = b.op("Slice", given, (*x.shape[:-1], width))
    again = sp.unary(b, y)
    if b.chance(0.5):
        sp.matmul(b, again, b.weight((again.width, 4)))


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


def several_axes(b: Builder) -> None:
    """Unsqueeze and Squeeze of two axes at once, with something between them."""
    x = b.rows(2, 3)
    axes = [0, x.rank + 1]
    shape = (1, *x.shape, 1)
    if b.opset >= 13:
        wide = b.op("Unsqueeze", [x, b.ints(*axes)], shape)
    else:
        wide = b.op("Unsqueeze", [x], shape, {"axes": axes})
    y = sp.unary(b, wide)
    if b.chance(0.5):
        y = sp.expand(b, y, [1] * (x.rank + 1) + [4])
        sp.reduce(b, "ReduceMean", y, [-1], keep=False)
        return
    if b.opset >= 13:
        b.op("Squeeze", [y, b.ints(*axes)], x.shape)
    else:
        b.op("Squeeze", [y], x.shape, {"axes": axes})


def chosen(b: Builder) -> None:
    """TopK, ScatterND, CumSum and Trilu: what rows become by their order."""
    x = b.rows(2, 3)
    kind = b.rng.randint(0, 3)
    shape = (*x.shape[:-1], 2)
    if kind == 0:
        values = Val(b.fresh("v"), shape, x.dtype)
        places = Val(b.fresh("v"), shape, INT64)
        b.emit("TopK", [x, b.ints(2)], [values, places], {"axis": -1})
        sp.unary(b, values)
    elif kind == 1:
        axis = b.const(np.asarray(x.rank - 1, np.int64))
        b.op("CumSum", [x, axis], x.shape)
    elif kind == 2 and b.opset >= 14:
        b.op("Trilu", [x], x.shape, {"upper": b.rng.randint(0, 1)})
    elif is_static(x.shape) and sizes(x.shape)[0]:
        update = b.const(b.normal((1, *sizes(x.shape)[1:])))
        b.op("ScatterND", [x, b.const(np.zeros((1, 1), np.int64)), update], x.shape)
