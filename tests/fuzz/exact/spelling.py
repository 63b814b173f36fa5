"""Operators as each opset spells them, the shapes of their outputs computed."""

from collections.abc import Sequence

import numpy as np

from tests.fuzz.exact.builder import (
    INT64,
    Attributes,
    Builder,
    Dim,
    Open,
    Shape,
    Val,
    broadcast,
    is_static,
    product,
)

UNARY: dict[str, tuple[int, bool]] = {
    "Abs": (11, True), "Cos": (11, True), "Elu": (11, False), "Erf": (11, False),
    "Identity": (11, True), "LeakyRelu": (11, False), "Neg": (11, True),
    "Relu": (11, True), "Selu": (11, False), "Sigmoid": (11, True), "Sin": (11, True),
    "Softplus": (11, False), "Softsign": (11, False), "Tanh": (11, True),
    "HardSigmoid": (11, False), "HardSwish": (14, False), "Celu": (12, False),
    "Gelu": (20, False), "Mish": (18, False), "Atan": (11, False),
}  # fmt: skip
"""Operators on one element that are tame: since when, and whether float64 too."""


def unary(b: Builder, x: Val, kind: str | None = None) -> Val:
    """Apply an operator to every element; a tame one is drawn."""
    known = [
        name
        for name, (since, double) in UNARY.items()
        if since <= b.opset and (double or not b.is_double)
    ]
    return b.op(kind or b.rng.choice(known), [x], x.shape)


def at_times(b: Builder, probability: float, x: Val) -> Val:
    """Apply a tame operator with some probability."""
    return unary(b, x) if b.chance(probability) else x


def binary(b: Builder, kind: str, left: Val, right: Val) -> Val:
    return b.op(kind, [left, right], broadcast(left.shape, right.shape))


def either_way(b: Builder, kind: str, left: Val, right: Val) -> Val:
    """Apply an operator of two operands, at times the other way round."""
    if kind != "Div" and b.chance(0.4):
        left, right = right, left
    return binary(b, kind, left, right)


def scalar(b: Builder, value: float, rank: int | None = None) -> Val:
    """Make a constant of one element, of some rank."""
    shape = (1,) * (b.rng.choice((0, 0, 1, 2)) if rank is None else rank)
    return b.const(np.full(shape, value, b.dtype))


def matmul(b: Builder, left: Val, right: Val) -> Val:
    """Multiply matrices; both have rank 2 or more."""
    lead = broadcast(left.shape[:-2], right.shape[:-2])
    return b.op("MatMul", [left, right], (*lead, left.shape[-2], right.shape[-1]))


def reshape(b: Builder, x: Val, dims: Sequence[Dim]) -> Val:
    """Reshape; an open dimension is written -1, or 0 where it stays in its place."""
    assert product(dims) == product(x.shape), (x.shape, dims)
    given: list[int] = []
    for axis, dim in enumerate(dims):
        kept = axis < x.rank and x.shape[axis] == dim
        if isinstance(dim, Open):
            given.append(0 if kept and b.chance(0.4) else -1)
        else:
            given.append(0 if kept and dim and b.chance(0.1) else dim)
    if is_static(dims) and given and 0 not in dims and b.chance(0.3):
        given[b.rng.randrange(len(given))] = -1
    return b.op("Reshape", [x, b.ints(*given)], dims)


def transpose(b: Builder, x: Val, order: Sequence[int]) -> Val:
    shape = [x.shape[axis] for axis in order]
    return b.op("Transpose", [x], shape, {"perm": list(order)})


def _signed(b: Builder, axis: int, rank: int) -> int:
    return axis - rank if b.chance(0.5) else axis


def softmax(b: Builder, x: Val, axis: int, kind: str = "Softmax") -> Val:
    """Take a softmax; before opset 13 it is over all axes from this one on."""
    return b.op(kind, [x], x.shape, {"axis": _signed(b, axis % x.rank, x.rank)})


def reduce(b: Builder, kind: str, x: Val, axes: Sequence[int], *, keep: bool) -> Val:
    """Reduce some axes, attribute or input as the opset has it."""
    gone = {axis % x.rank for axis in axes}
    shape: list[Dim] = []
    for axis, dim in enumerate(x.shape):
        if axis not in gone:
            shape.append(dim)
        elif keep:
            shape.append(1)
    listed = [_signed(b, axis, x.rank) for axis in sorted(gone)]
    attributes = {} if keep and b.chance(0.5) else {"keepdims": int(keep)}
    if b.opset >= (13 if kind == "ReduceSum" else 18):
        return b.op(kind, [x, b.ints(*listed)], shape, attributes)
    return b.op(kind, [x], shape, {"axes": listed, **attributes})


def _axes_of(b: Builder, axes: Sequence[int]) -> tuple[list[Val], Attributes]:
    if b.opset >= 13:
        return [b.ints(*axes)], {}
    return [], {"axes": list(axes)}


def unsqueeze(b: Builder, x: Val, axis: int) -> Val:
    shape = list(x.shape)
    shape.insert(axis, 1)
    more, attributes = _axes_of(b, [_signed(b, axis, x.rank + 1)])
    return b.op("Unsqueeze", [x, *more], shape, attributes)


def squeeze(b: Builder, x: Val, axis: int) -> Val:
    shape = [dim for at, dim in enumerate(x.shape) if at != axis % x.rank]
    more, attributes = _axes_of(b, [_signed(b, axis % x.rank, x.rank)])
    return b.op("Squeeze", [x, *more], shape, attributes)


def slice_(b: Builder, x: Val, axis: int, start: int, end: int) -> Val:
    """Cut a piece out of an axis of known size; steps are left out at times."""
    shape = list(x.shape)
    shape[axis] = end - start
    given = [x, b.ints(start), b.ints(end), b.ints(_signed(b, axis, x.rank))]
    if b.chance(0.4):
        given.append(b.ints(1))
    return b.op("Slice", given, shape)


def gather(b: Builder, x: Val, indices: Val, axis: int) -> Val:
    shape = (*x.shape[:axis], *indices.shape, *x.shape[axis + 1 :])
    return b.op("Gather", [x, indices], shape, {"axis": _signed(b, axis, x.rank)})


def concat(b: Builder, parts: Sequence[Val], axis: int) -> Val:
    first = parts[0]
    total = sum(_size(each.shape[axis]) for each in parts)
    shape = list(first.shape)
    shape[axis] = total
    return b.op("Concat", parts, shape, {"axis": _signed(b, axis, first.rank)})


def _size(dim: Dim) -> int:
    assert isinstance(dim, int)
    return dim


def tile(b: Builder, x: Val, repeats: Sequence[int]) -> Val:
    shape: Shape = tuple(
        Open(dim.times * count) if isinstance(dim, Open) else dim * count
        for dim, count in zip(x.shape, repeats, strict=True)
    )
    return b.op("Tile", [x, b.ints(*repeats)], shape)


def expand(b: Builder, x: Val, target: Sequence[int]) -> Val:
    """Expand; the target may have ones where the value is larger."""
    shape = broadcast(x.shape, target)
    return b.op("Expand", [x, b.ints(*target)], shape)


def split(b: Builder, x: Val, axis: int, pieces: Sequence[int]) -> list[Val]:
    """Cut an axis of known size into pieces."""
    outputs = []
    for size in pieces:
        shape = list(x.shape)
        shape[axis] = size
        outputs.append(Val(b.fresh("v"), tuple(shape), x.dtype))
    at = _signed(b, axis, x.rank)
    if b.opset >= 13:
        b.emit("Split", [x, b.ints(*pieces)], outputs, {"axis": at})
    else:
        b.emit("Split", [x], outputs, {"axis": at, "split": list(pieces)})
    return outputs


def clip(b: Builder, x: Val, low: float | None, high: float | None) -> Val:
    """Clip; a bound may be left out."""
    if b.is_double and b.opset < 12:
        return x
    bounds = [None if each is None else scalar(b, each, 0) for each in (low, high)]
    return b.op("Clip", [x, *bounds], x.shape)


def shape_of(b: Builder, x: Val) -> Val:
    return b.op("Shape", [x], (x.rank,), dtype=INT64)


def flatten(b: Builder, x: Val, axis: int) -> Val:
    shape = (product(x.shape[:axis]), product(x.shape[axis:]))
    return b.op("Flatten", [x], shape, {"axis": axis})
