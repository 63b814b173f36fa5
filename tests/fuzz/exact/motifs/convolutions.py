"""Convolutions, what scales their channels, and weights that several layers share."""

import dataclasses

import numpy as np

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import Builder
from tests.fuzz.exact.motifs.linear import gemm
from tests.fuzz.exact.values import Val, is_static, sizes


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
