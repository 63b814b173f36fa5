"""Layers as exporters spell them: linear, convolutions, norms and activations."""

import dataclasses
import math

import numpy as np

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import Builder, Val, is_static, product, sizes


def layer(b: Builder, x: Val, width: int | None = None) -> Val:
    """Multiply rows by a matrix, with or without a bias, in one of the spellings."""
    columns = width or b.rng.choice((3, 4, 6, 8, 12, 16))
    spellings = [_matmul, _matmul, _turned]
    if x.rank == 2:
        spellings += [gemm, gemm]
    if x.rank > 2:
        spellings.append(_flat_gemm)
    if x.rank == 3 and not b.is_double:
        spellings.append(_conv)
    if b.opset >= 12:
        spellings.append(_einsum)
    return b.rng.choice(spellings)(b, x, columns)


def _biased(b: Builder, product_: Val) -> Val:
    if b.chance(0.35):
        return product_
    shape = b.rng.choice([(product_.width,)] * 6 + [(1, product_.width), (1,), ()])
    bias = b.weight(shape, 0.5)
    kind = b.rng.choice(("Add", "Add", "Add", "Sub"))
    return sp.either_way(b, kind, product_, bias)


def _matmul(b: Builder, x: Val, columns: int) -> Val:
    return _biased(b, sp.matmul(b, x, b.weight((x.width, columns))))


def _turned(b: Builder, x: Val, columns: int) -> Val:
    weight = b.weight((columns, x.width), x.width**-0.5)
    return _biased(b, sp.matmul(b, x, sp.transpose(b, weight, (1, 0))))


def gemm(b: Builder, x: Val, columns: int) -> Val:
    """Write one Gemm on a weight that others may have."""
    turned = b.rng.randint(0, 1)
    shape = (columns, x.width) if turned else (x.width, columns)
    inputs = [x, b.weight(shape, x.width**-0.5)]
    attributes: dict[str, float | int] = {}
    if turned or b.chance(0.3):
        attributes["transB"] = turned
    if b.chance(0.25):
        attributes["alpha"] = b.rng.choice((0.5, 2.0, -1.5))
    if b.chance(0.7):
        inputs.append(b.weight(b.rng.choice([(columns,)] * 4 + [(1, columns), ()]), 1))
        if b.chance(0.2):
            attributes["beta"] = b.rng.choice((0.0, 0.5, 2.0))
    return b.op("Gemm", inputs, (*x.shape[:-1], columns), attributes)


def _flat_gemm(b: Builder, x: Val, columns: int) -> Val:
    flat = sp.reshape(b, x, (product(x.shape[:-1]), x.width))
    return sp.reshape(b, gemm(b, flat, columns), (*x.shape[:-1], columns))


def _conv(b: Builder, x: Val, columns: int) -> Val:
    turned = sp.transpose(b, x, (0, 2, 1))
    inputs = [turned, b.weight((columns, x.width, 1), x.width**-0.5)]
    if b.chance(0.6):
        inputs.append(b.weight((columns,), 0.5))
    shape = (x.shape[0], columns, x.shape[1])
    return sp.transpose(b, b.op("Conv", inputs, shape), (0, 2, 1))


def _einsum(b: Builder, x: Val, columns: int) -> Val:
    letters = "abcdefg"[: x.rank - 1]
    flip = b.chance(0.5)
    shape = (columns, x.width) if flip else (x.width, columns)
    equation = f"{letters}k,{'nk' if flip else 'kn'}->{letters}n"
    weight = b.weight(shape, x.width**-0.5)
    made = b.op("Einsum", [x, weight], (*x.shape[:-1], columns), {"equation": equation})
    return _biased(b, made)


def one_layer(b: Builder) -> None:
    """A layer, perhaps with an activation behind it."""
    made = layer(b, b.rows())
    sp.at_times(b, 0.5, made)


def layers_in_a_row(b: Builder) -> None:
    """Layers on layers, at times with a factor or a residual between."""
    x = b.rows()
    for _ in range(b.rng.randint(2, 3)):
        before, x = x, layer(b, x, b.rng.choice((None, x.width)))
        if x.shape == before.shape and b.chance(0.3):
            x = sp.binary(b, b.rng.choice(("Add", "Sub", "Mul")), x, before)
        if b.chance(0.3):
            factor = sp.scalar(b, b.rng.choice((0.5, -2.0, 3.0, 0.1)))
            if factor.rank <= x.rank:
                x = sp.binary(b, b.rng.choice(("Mul", "Div")), x, factor)


def on_positions(b: Builder) -> None:
    """A layer on a value plus a layer of positions and a constant."""
    x = b.rows(2, 4)
    narrow = b.rng.choice((1, 2, 3))
    lead = list(x.shape[:-1])
    for axis in range(len(lead)):
        if b.chance(0.3):
            lead[axis] = 1
    first = b.rng.randint(0, len(lead) - 1) if b.chance(0.3) else 0
    positions = b.input([*lead[first:], narrow]) if first < len(lead) else x
    wide = sp.matmul(b, positions, b.weight((narrow, x.width)))
    if b.chance(0.7):
        wide = sp.binary(b, "Add", wide, b.weight((x.width,), 0.5))
    kind = b.rng.choice(("Add", "Add", "Sub"))
    both = sp.either_way(b, kind, x, wide)
    layer(b, both)
    if b.chance(0.3):
        layer(b, both)


def on_points(b: Builder) -> None:
    """A matrix for each camera times the vectors of all points; one may be repeated."""
    cameras, points = b.rng.choice((1, 3)), b.rng.choice((4, 60, 200))
    size, columns = b.rng.choice((3, 4)), b.rng.choice((1, 1, 2))
    matrices = b.input([cameras, 1, size, size])
    if b.chance(0.3):
        matrices = sp.tile(b, matrices, (1, points, 1, 1))
    elif b.chance(0.3):
        matrices = sp.unsqueeze(b, matrices, 0)
    vectors = b.input([1, points, size, columns])
    if b.chance(0.3):
        vectors = sp.expand(b, vectors, (cameras, points, size, columns))
    sp.matmul(b, matrices, vectors)


def on_columns(b: Builder) -> None:
    """A layer on columns side by side, some of them repeated or constant."""
    x = b.rows(2, 3)
    parts = [x]
    for _ in range(b.rng.randint(1, 2)):
        width = b.rng.choice((1, 2, 4, 8))
        kind = b.rng.random()
        if kind < 0.3 and is_static(x.shape):
            parts.append(b.const(b.normal((*sizes(x.shape[:-1]), width))))
        elif kind < 0.6:
            small = b.input([*([1] * (x.rank - 1)), width])
            if is_static(x.shape):
                parts.append(sp.expand(b, small, (*sizes(x.shape[:-1]), width)))
        elif kind < 0.8:
            parts.append(sp.matmul(b, x, b.weight((x.width, width))))
        else:
            parts.append(x)
    b.rng.shuffle(parts)
    layer(b, sp.concat(b, parts, x.rank - 1))


def same_source(b: Builder) -> None:
    """Several layers that read one value: queries, keys and values."""
    x = b.rows(2, 3)
    made = [layer(b, x) for _ in range(b.rng.randint(2, 4))]
    sp.at_times(b, 0.3, made[0])
    if made[0].shape == made[1].shape and b.chance(0.5):
        sp.binary(b, "Add", made[0], made[1])


@dataclasses.dataclass(frozen=True)
class Kernel:
    """The weight of a convolution and how it is read."""

    weight: Val
    group: int
    size: int
    turned: bool

    @property
    def channels(self) -> int:
        given = sizes(self.weight.shape)
        return given[1] * self.group if self.turned else given[0]


def kernel(b: Builder, channels: int) -> Kernel:
    """Draw the weight of a Conv or ConvTranspose on so many channels."""
    turned = b.chance(0.35)
    groups = [each for each in (1, 1, 2, channels) if channels % each == 0]
    group, size = b.rng.choice(groups), b.rng.choice((1, 1, 2, 3))
    if turned:
        shape = (channels, b.rng.choice((1, 2, 4)), size, size)
    else:
        out = b.rng.choice((1, 2, 4)) * group
        shape = (out, channels // group, size, size)
    return Kernel(b.weight(shape, (channels * size) ** -0.5), group, size, turned)


def convolve(b: Builder, x: Val, with_: Kernel, bias: Val | None = None) -> Val:
    """Apply a kernel; a Conv is padded so that nothing becomes empty."""
    height, width = sizes(x.shape[2:])
    attributes: dict[str, object] = {"kernel_shape": [with_.size] * 2}
    if with_.group > 1 or b.chance(0.2):
        attributes["group"] = with_.group
    more = with_.size - 1
    if not with_.turned:
        attributes["pads"] = [*([more // 2] * 2), *([more - more // 2] * 2)]
        more = 0
    kind = "ConvTranspose" if with_.turned else "Conv"
    shape = (x.shape[0], with_.channels, height + more, width + more)
    inputs = [x, with_.weight] + ([] if bias is None else [bias])
    return b.op(kind, inputs, shape, attributes)


def _statistics(b: Builder, channels: int) -> list[Val]:
    return [
        b.const(b.uniform(0.5, 1.5, (channels,))),
        b.const(b.normal((channels,))),
        b.const(b.normal((channels,), 0.3)),
        b.const(b.uniform(0.3, 2, (channels,))),
    ]


def follow(b: Builder, x: Val, shared: list[Val] | None = None) -> Val:
    """Scale or shift the channels of what a layer gave: axis 1 of any rank."""
    channels = sizes(x.shape[1:2])[0]
    if b.chance(0.45):
        attributes = {"epsilon": 1e-3} if b.chance(0.3) else {}
        fits = shared is not None and shared[0].shape == (channels,)
        statistics = shared if shared and fits else _statistics(b, channels)
        return b.op("BatchNormalization", [x, *statistics], x.shape, attributes)
    kind = b.rng.choice(("Add", "Sub", "Mul", "Div"))
    wide = (channels, *([1] * (x.rank - 2)))
    shapes = [wide, wide, (1, *wide), (), (1,), (1,) * x.rank]
    if x.shape[0] == 1:
        shapes.append((2, *wide))
    if channels == 1:
        shapes.append((3, *([1] * (x.rank - 2))))
    if is_static(x.shape[2:]):
        shapes.append((channels, *sizes(x.shape[2:])))
    shape = b.rng.choice(shapes)
    array = b.uniform(0.5, 2, shape) * b.draws.choice((-1, 1), shape)
    if b.chance(0.1):
        array = np.asarray(array * 0 + b.rng.choice((0.0, 1.0, -0.0)))
        kind = "Mul" if kind == "Div" else kind
    other = b.const(np.asarray(array, b.dtype))
    return sp.either_way(b, kind, x, other)


def _bias(b: Builder, channels: int) -> Val | None:
    return b.weight((channels,), 0.5) if b.chance(0.5) else None


def conv_and_norm(b: Builder) -> None:
    """A convolution and up to three nodes that scale its channels."""
    if b.is_double:
        return
    x = b.image()
    used = kernel(b, sizes(x.shape[1:2])[0])
    y = convolve(b, x, used, _bias(b, used.channels))
    for _ in range(b.rng.randint(1, 3)):
        y = follow(b, y)
        y = sp.at_times(b, 0.15, y)


def shared_kernel(b: Builder) -> None:
    """Two or three convolutions on one weight, each followed by its own."""
    if b.is_double:
        return
    x = b.image()
    used = kernel(b, sizes(x.shape[1:2])[0])
    common = _statistics(b, used.channels) if b.chance(0.5) else None
    bias = _bias(b, used.channels)
    results: list[Val] = []
    for turn in range(b.rng.randint(2, 3)):
        if turn and results[-1].shape == x.shape and b.chance(0.5):
            x = results[-1]
        elif turn and b.chance(0.5):
            x = sp.unary(b, x)
        same = bias if b.chance(0.6) else _bias(b, used.channels)
        results.append(convolve(b, x, used, same))
    for at in range(len(results)):
        for _ in range(b.rng.randint(0, 3)):
            results[at] = follow(b, results[at], common)
    if b.chance(0.4) and results[0].shape == results[1].shape:
        sp.binary(b, "Add", results[0], results[1])


def shared_square(b: Builder) -> None:
    """MatMul and Gemm, turned or not, on one square weight and one bias."""
    x = b.rows(2, 2)
    width = x.width
    weight = b.weight((width, width))
    bias = b.weight((width,), 0.5)
    made: list[Val] = []
    for _ in range(b.rng.randint(2, 4)):
        y = x if not made or b.chance(0.5) else made[-1]
        if b.chance(0.4):
            y = sp.matmul(b, y, weight)
            if b.chance(0.6):
                y = sp.binary(b, "Add", y, bias)
        elif b.chance(0.3):
            y = gemm(b, y, width)
        else:
            inputs = [y, weight] + ([bias] if b.chance(0.6) else [])
            attributes = {"transB": 1} if b.chance(0.4) else {}
            y = b.op("Gemm", inputs, y.shape, attributes)
        for _ in range(b.rng.randint(0, 2)):
            y = follow(b, y)
        made.append(y)


def alias_of_a_weight(b: Builder) -> None:
    """A weight that an Identity gives a second name, as torch exports shared ones."""
    x = b.rows(2, 3)
    weight = b.weight((x.width, x.width))
    other = b.op("Identity", [weight], weight.shape)
    y = sp.matmul(b, sp.matmul(b, x, weight), other)
    if b.chance(0.5):
        y = sp.binary(b, "Mul", y, sp.scalar(b, 0.5, 1))
    if b.chance(0.5):
        sp.matmul(b, y, sp.transpose(b, other, (1, 0)))


def _square(b: Builder, x: Val) -> Val:
    if b.chance(0.7):
        two = b.const(np.asarray(2, b.rng.choice((b.dtype, b.dtype, np.int64))))
        if two.dtype == b.dtype or b.opset >= 12:
            return b.op("Pow", [x, two], x.shape)
    return sp.binary(b, "Mul", x, x)


def layer_norm(b: Builder) -> None:
    """Mean, difference, variance, root, division, gamma and beta."""
    x = b.rows(2, 4)
    axis = -1 if b.chance(0.85) else b.rng.randint(0, x.rank - 1)
    mean = sp.reduce(b, "ReduceMean", x, [axis], keep=True)
    off = sp.binary(b, "Sub", x, mean)
    other = off if b.chance(0.7) else sp.binary(b, "Sub", x, mean)
    variance = sp.reduce(b, "ReduceMean", _square(b, off), [axis], keep=True)
    made = _rooted(b, other, variance)
    if b.chance(0.85):
        made = _scaled(b, made, "Mul")
        if b.chance(0.8):
            _scaled(b, made, "Add")


def _rooted(b: Builder, x: Val, variance: Val) -> Val:
    epsilon = sp.scalar(b, b.rng.choice((1e-5, 1e-3, 1e-1)))
    if epsilon.rank > variance.rank:
        epsilon = sp.scalar(b, 1e-4, 0)
    total = sp.either_way(b, "Add", variance, epsilon)
    root = b.op("Sqrt", [total], variance.shape)
    way = b.rng.random()
    if way < 0.6:
        return sp.binary(b, "Div", x, root)
    if way < 0.8:
        return sp.binary(b, "Mul", x, b.op("Reciprocal", [root], root.shape))
    inverse = sp.binary(b, "Div", sp.scalar(b, 1.0, 0), root)
    return sp.binary(b, "Mul", x, inverse)


def _scaled(b: Builder, x: Val, kind: str) -> Val:
    shape = b.rng.choice([(x.width,)] * 5 + [(1, x.width), ()])
    gamma = b.weight(shape, 0.7)
    return sp.either_way(b, kind, x, gamma)


def gelu(b: Builder) -> None:
    """The erf or the tanh form, its factors in any order."""
    x = b.rows(1, 4)
    if b.chance(0.5) and not b.is_double:
        root = sp.scalar(b, math.sqrt(2), 0)
        inner = sp.binary(b, "Div", x, root)
        if b.chance(0.3):
            inner = sp.binary(b, "Mul", x, sp.scalar(b, 1 / math.sqrt(2), 0))
        wave = b.op("Erf", [inner], x.shape)
    else:
        cube = b.op("Pow", [x, sp.scalar(b, 3.0, 0)], x.shape)
        small = sp.binary(b, "Mul", cube, sp.scalar(b, 0.044715, 0))
        both = sp.binary(b, "Add", x, small)
        scale = sp.scalar(b, math.sqrt(2 / math.pi), 0)
        wave = b.op("Tanh", [sp.binary(b, "Mul", both, scale)], x.shape)
    bracket = sp.binary(b, "Add", wave, sp.scalar(b, 1.0, 0))
    half = sp.scalar(b, b.rng.choice((0.5, 0.5, 0.5, 0.25)), 0)
    if b.chance(0.5):
        sp.binary(b, "Mul", sp.binary(b, "Mul", x, bracket), half)
    else:
        sp.binary(b, "Mul", sp.binary(b, "Mul", x, half), bracket)


def swish(b: Builder) -> None:
    x = b.rows(1, 4)
    gate = b.op("Sigmoid", [x], x.shape)
    sp.either_way(b, "Mul", x, gate)


def hard_swish(b: Builder) -> None:
    """x * clip(x + 3, 0, 6) / 6, or by HardSigmoid."""
    x = b.rows(1, 4)
    if not b.is_double and b.chance(0.3):
        attributes = {"alpha": 1 / 6, "beta": 0.5} if b.chance(0.7) else {}
        gate = b.op("HardSigmoid", [x], x.shape, attributes)
        sp.binary(b, "Mul", x, gate)
        return
    moved = sp.binary(b, "Add", x, sp.scalar(b, 3.0))
    gate = sp.clip(b, moved, 0.0, b.rng.choice((6.0, 6.0, 6.0, None)))
    six = sp.scalar(b, 6.0)
    if b.chance(0.5):
        sp.binary(b, "Mul", x, sp.binary(b, "Div", gate, six))
    else:
        sp.binary(b, "Div", sp.binary(b, "Mul", x, gate), six)


def mish(b: Builder) -> None:
    """x * tanh(softplus(x)), the softplus in one or in three operators."""
    x = b.rows(1, 4)
    if b.chance(0.5) and not b.is_double:
        plus = b.op("Softplus", [x], x.shape)
    else:
        low = sp.clip(b, x, None, 20.0) if b.chance(0.5) else x
        plus = b.op("Exp", [low], x.shape)
        one = sp.binary(b, "Add", plus, sp.scalar(b, 1.0, 0))
        plus = b.op("Log", [one], x.shape)
    wave = b.op("Tanh", [plus], x.shape)
    sp.either_way(b, "Mul", x, wave)


def constant_chain(b: Builder) -> None:
    """Add, subtract, multiply and divide by constants in a row."""
    x = b.rows(1, 4)
    for _ in range(b.rng.randint(2, 4)):
        kind = b.rng.choice(("Add", "Sub", "Mul", "Div", "Mul", "Add", "Max", "Min"))
        number = b.rng.choice((2.0, 0.5, -3.0, 0.1, 1.0, -1.0, 0.0, -0.0, 1e-3))
        if kind == "Div" and number == 0:
            number = 4.0
        other = sp.scalar(b, number)
        if b.chance(0.4):
            other = b.const(b.uniform(0.5, 2, (x.width,)))
        if other.rank > x.rank:
            continue
        x = sp.either_way(b, kind, x, other)
