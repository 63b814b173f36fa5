"""Forms: small graphs in which onnxruntime's int8 kernels meet what is around them.

Each is what a placement has to decide as a whole: a layer by kernel, stride, group and
channels, and what stands between two layers, in front of one or behind it. Sizes are
those of backbones, necks and heads at batch 1, and of lines of text.
"""

import dataclasses
import re
from collections.abc import Iterator, Sequence

PLACEHOLDER = re.compile(r"\{([\d,]+)\}")


@dataclasses.dataclass(frozen=True)
class Form:
    """A graph with one input, and weights that are still to be drawn.

    Attributes:
        name: what it shows.
        read: shape of its input, float32.
        body: its nodes as ONNX text, from ``x`` to ``y``; ``{64,32,3,3}`` is a weight
            or bias of that shape.
    """

    name: str
    read: tuple[int, ...]
    body: str

    def text(self) -> str:
        """Write it as a function of its input and its weights."""
        shapes = PLACEHOLDER.findall(self.body)
        numbers = iter(range(len(shapes)))
        nodes = PLACEHOLDER.sub(lambda _: f"w{next(numbers)}", self.body)
        weights = [f"float[{dims}] w{place}" for place, dims in enumerate(shapes)]
        inputs = ", ".join([f"float[{','.join(map(str, self.read))}] x", *weights])
        header = '<ir_version: 9, opset_import: ["" : 17]>'
        return f"{header}\nform ({inputs}) => (float y) {{\n{nodes}}}"


def conv(
    channels: tuple[int, int],
    kernel: int = 1,
    *,
    stride: int = 1,
    group: int = 1,
    names: tuple[str, str] = ("x", "y"),
    relu: bool = True,
) -> str:
    """Write a convolution that keeps the size, before the stride, with its ReLU."""
    (read, made), (source, result) = channels, names
    edge = kernel // 2
    options = f"group={group}, strides=[{stride},{stride}]"
    options += f", pads=[{edge},{edge},{edge},{edge}]"
    weight = f"{{{made},{read // group},{kernel},{kernel}}}"
    last = f"{result}_c" if relu else result
    line = f"  {last} = Conv<{options}>({source}, {weight}, {{{made}}})\n"
    return line + (f"  {result} = Relu({last})\n" if relu else "")


def single_layers() -> Iterator[Form]:
    """Yield one layer each: float before it and behind it."""
    # channels, kernel, stride, groups, side or sides
    for made, kernel, stride, group, (high, wide) in (
        ((64, 64), 3, 1, 1, (56, 56)),
        ((64, 128), 3, 2, 1, (56, 56)),
        ((256, 256), 3, 1, 1, (14, 14)),
        ((16, 16), 3, 1, 1, (112, 112)),
        ((30, 30), 3, 1, 1, (56, 56)),
        ((128, 128), 3, 1, 32, (28, 28)),
        ((96, 96), 3, 1, 96, (56, 56)),
        ((96, 96), 3, 2, 96, (56, 56)),
        ((200, 200), 5, 1, 200, (2, 96)),
        ((64, 256), 1, 1, 1, (56, 56)),
        ((256, 64), 1, 1, 1, (56, 56)),
        ((256, 512), 1, 2, 1, (56, 56)),
        ((8, 16), 1, 1, 1, (24, 96)),
        ((32, 200), 1, 1, 1, (2, 96)),
        ((200, 32), 1, 1, 1, (2, 96)),
        ((200, 48), 1, 1, 1, (1, 1)),
        ((512, 512), 1, 1, 1, (1, 1)),
        ((3, 16), 3, 2, 1, (224, 224)),
        ((3, 64), 7, 2, 1, (224, 224)),
    ):
        grouped = "" if group == 1 else f" in {group} groups"
        text = f"Conv {kernel}x{kernel}/{stride} {made[0]} to {made[1]}{grouped}"
        body = conv(made, kernel, stride=stride, group=group)
        yield Form(f"{text}, {high} x {wide}", (1, made[0], high, wide), body)
    for rows, depth, columns in (
        (1, 256, 256),
        (1, 1024, 1000),
        (16, 256, 256),
        (300, 256, 256),
        (2500, 256, 256),
    ):
        product = f"  p = MatMul(x, {{{depth},{columns}}})\n"
        biased = f"{product}  y = Add(p, {{{columns}}})\n"
        name = f"MatMul, Add {depth} to {columns}, rows {rows}"
        yield Form(name, (1, rows, depth), biased)
    product = "  y = MatMul(x, {256,256})\n"
    yield Form("MatMul 256 to 256, rows 300", (1, 300, 256), product)
    gemm = "  y = Gemm<transB=1>(x, {1000,1024}, {1000})\n"
    yield Form("Gemm 1024 to 1000, rows 1", (1, 1024), gemm)


TWICE = "  n = Constant<value = float[4] {1.0, 1.0, 2.0, 2.0}>()\n"
POOL = "Pool<kernel_shape=[2,2], strides=[2,2]>(a)\n"
BETWEEN = {
    "MaxPool": f"  b = Max{POOL}",
    "AveragePool": f"  b = Average{POOL}",
    "Resize, nearest": TWICE + '  b = Resize<mode="nearest", nearest_mode="floor",'
    ' coordinate_transformation_mode="asymmetric">(a, , n)\n',
    "Resize, linear": f'{TWICE}  b = Resize<mode="linear">(a, , n)\n',
    "SiLU": "  s = Sigmoid(a)\n  b = Mul(a, s)\n",
    "HardSwish of four": "  three = Constant<value = float {3.0}>()\n"
    "  none = Constant<value = float {0.0}>()\n"
    "  six = Constant<value = float {6.0}>()\n"
    "  h1 = Add(a, three)\n  h2 = Clip(h1, none, six)\n  h3 = Mul(a, h2)\n"
    "  b = Div(h3, six)\n",
    "LeakyRelu": "  b = LeakyRelu<alpha=0.1>(a)\n",
    "depthwise 3x3": conv((64, 64), 3, group=64, names=("a", "b")),
    "depthwise 3x3, SiLU": conv((64, 64), 3, group=64, names=("a", "d"), relu=False)
    + "  s = Sigmoid(d)\n  b = Mul(d, s)\n",
    "Add of a third": conv((64, 64), names=("x", "o")) + "  b = Add(a, o)\n",
    "Add of the input": "  b = Add(a, x)\n",
    "Concat with a third": conv((64, 64), names=("x", "o"))
    + "  b = Concat<axis=1>(a, o)\n",
}
"""What may stand between two layers of 64 channels, from ``a`` to ``b``."""


def between_layers() -> Iterator[Form]:
    """Yield two convolutions, of 1 x 1 and 3 x 3, with something between them."""
    pair = conv((64, 64), names=("x", "a")) + conv((64, 64), 3, names=("a", "y"))
    yield Form("Conv, Conv, 28 x 28", (1, 64, 28, 28), pair)
    for name, nodes in BETWEEN.items():
        read = 128 if name.startswith("Concat") else 64
        relu = not any(part in name for part in ("SiLU", "Swish", "Leaky"))
        relu = relu or name.startswith("depthwise")
        body = conv((64, 64), names=("x", "a"), relu=relu) + nodes
        body += conv((read, 64), 3, names=("b", "y"))
        yield Form(f"Conv, {name}, Conv, 28 x 28", (1, 64, 28, 28), body)


def around_layers() -> Iterator[Form]:
    """Yield stems, heads, and what reads a layer in float."""
    pool = "MaxPool<kernel_shape=[3,3], strides=[2,2], pads=[1,1,1,1]>"
    stem = conv((3, 64), 7, stride=2, names=("x", "a"))
    image = (1, 3, 224, 224)
    yield Form("stem 7x7, MaxPool", image, f"{stem}  y = {pool}(a)\n")
    body = f"{stem}  b = {pool}(a)\n" + conv((64, 64), 3, names=("b", "y"))
    yield Form("stem 7x7, MaxPool, Conv 3x3", image, body)
    body = conv((3, 16), 3, stride=2, names=("x", "a"))
    body += conv((16, 16), 3, group=16, names=("a", "y"))
    yield Form("stem 3x3, depthwise 3x3", image, body)
    layer = conv((64, 64), 3, names=("x", "a"), relu=False)
    maps = (1, 64, 28, 28)
    yield Form("Conv 3x3, Sigmoid", maps, f"{layer}  y = Sigmoid(a)\n")
    two = "  s = Sigmoid(a)\n  t = Abs(a)\n  y = Add(s, t)\n"
    yield Form("Conv 3x3, two that read float", maps, layer + two)
    for count, (high, wide) in (
        (32, (56, 56)),
        (96, (14, 14)),
        (200, (2, 96)),
        (480, (14, 14)),
        (960, (7, 7)),
        (2048, (7, 7)),
    ):
        squeezed = (
            "  g = GlobalAveragePool(x)\n"
            + conv((count, count // 4), names=("g", "r"))
            + conv((count // 4, count), names=("r", "e"), relu=False)
            + "  s = HardSigmoid<alpha=0.2>(e)\n  y = Mul(x, s)\n"
        )
        name = f"squeeze and excite, {count} channels, {high} x {wide}"
        yield Form(name, (1, count, high, wide), squeezed)
    body = conv((32, 200), names=("x", "a"), relu=False) + BETWEEN["HardSwish of four"]
    yield Form(
        "Conv 32 to 200, HardSwish, 2 x 96", (1, 32, 2, 96), f"{body}  y = Abs(b)\n"
    )
    for name, high, wide in (("56 x 56", 56, 56), ("7 x 7", 7, 7)):
        body = (
            conv((24, 144), names=("x", "a"))
            + conv((144, 144), 3, group=144, names=("a", "b"))
            + conv((144, 24), names=("b", "c"), relu=False)
            + "  y = Add(x, c)\n"
        )
        yield Form(f"inverted residual 24, 144, {name}", (1, 24, high, wide), body)


def products() -> Iterator[Form]:
    """Yield products that belong together."""
    for rows in (1, 16, 300, 2500):
        body = (
            "  p = MatMul(x, {256,1024})\n  a = Add(p, {1024})\n  r = Relu(a)\n"
            "  q = MatMul(r, {1024,256})\n  y = Add(q, {256})\n"
        )
        name = f"feed forward 256, 1024, rows {rows}"
        yield Form(name, (1, rows, 256), body)
        gelu = "  e = Erf(a)\n  r = Mul(a, e)\n"
        yield Form(
            f"{name}, Erf", (1, rows, 256), body.replace("  r = Relu(a)\n", gelu)
        )
    norm = (
        "  p = MatMul(x, {256,256})\n  a = Add(p, {256})\n"
        "  n = LayerNormalization(a, {256}, {256})\n"
        "  q = MatMul(n, {256,256})\n  y = Add(q, {256})\n"
    )
    yield Form("MatMul, LayerNormalization, MatMul, rows 300", (1, 300, 256), norm)
    attention = (
        "  q = MatMul(x, {256,256})\n  k = MatMul(x, {256,256})\n"
        "  v = MatMul(x, {256,256})\n  t = Transpose<perm=[0,2,1]>(k)\n"
        "  z = MatMul(q, t)\n  s = Softmax<axis=-1>(z)\n  y = MatMul(s, v)\n"
    )
    yield Form(
        "attention of 300, both products of activations", (1, 300, 256), attention
    )


def forms() -> Sequence[Form]:
    """Return all of them."""
    return [*single_layers(), *between_layers(), *around_layers(), *products()]
