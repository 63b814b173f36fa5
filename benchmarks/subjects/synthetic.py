"""A graph of any size with VAD-tiny's mix of operators, as TorchScript exports it.

Blocks of the kinds that a driving stack is made of (convolution, attention, deformable
sampling, feed-forward, reference-point arithmetic) are repeated with fresh weights
until the graph has the wanted number of nodes. Shapes are static but, as in a raw
export, computed by Shape, Gather, Unsqueeze, Concat chains; constants are nodes;
identities, repeated expressions and float scalars stand where the exporter puts them.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx

OPSET = 17
WIDTH, TOKENS, HEADS, GRID = 32, 64, 4, 8


@dataclasses.dataclass
class Builder:
    """Appends nodes to a graph, TorchScript style."""

    generator: np.random.Generator
    nodes: list[onnx.NodeProto] = dataclasses.field(default_factory=list)
    weights: list[onnx.TensorProto] = dataclasses.field(default_factory=list)
    scope: str = ""

    def add(self, op_type: str, *inputs: str, **attributes: Any) -> str:
        name = f"{self.scope}/{op_type}_{len(self.nodes)}"
        result = f"{name}_output_0"
        node = onnx.helper.make_node(op_type, inputs, [result], name, **attributes)
        self.nodes.append(node)
        return result

    def constant(self, value: npt.ArrayLike, kind: npt.DTypeLike = np.int64) -> str:
        result = self.add("Constant")
        tensor = onnx.numpy_helper.from_array(np.asarray(value, kind))
        self.nodes[-1].attribute.append(onnx.helper.make_attribute("value", tensor))
        return result

    def weight(self, name: str, *shape: int) -> str:
        return self._stored(name, self.generator.normal(0, 0.1, shape))

    def positive(self, name: str, *shape: int) -> str:
        return self._stored(name, self.generator.uniform(0.5, 1.5, shape))

    def _stored(self, name: str, array: npt.NDArray[np.floating]) -> str:
        full = f"{self.scope.strip('/').replace('/', '.')}.{name}.{len(self.weights)}"
        tensor = onnx.numpy_helper.from_array(array.astype(np.float32), full)
        self.weights.append(tensor)
        return full

    def size(self, value: str, axis: int) -> str:
        """One dimension, the way an exporter reads it: Shape, Gather, Unsqueeze."""
        dimension = self.add(
            "Gather", self.add("Shape", value), self.constant(axis), axis=0
        )
        return self.add("Unsqueeze", dimension, self.constant([0]))

    def view(self, value: str, *sizes: str | int) -> str:
        parts = [
            self.add("Unsqueeze", self.constant(size), self.constant([0]))
            if isinstance(size, int)
            else size
            for size in sizes
        ]
        return self.add("Reshape", value, self.add("Concat", *parts, axis=0))

    def linear(self, value: str) -> str:
        matrix = self.add("Transpose", self.weight("weight", WIDTH, WIDTH), perm=[1, 0])
        bias = self.weight("bias", WIDTH)
        return self.add("Add", bias, self.add("MatMul", value, matrix))

    def slice(self, value: str, start: int, end: int, axis: int) -> str:
        bounds = [self.constant([bound]) for bound in (start, end, axis, 1)]
        return self.add("Slice", value, *bounds)


def _attention(build: Builder, tokens: str) -> str:
    heads = []
    for _ in range(3):
        projected = build.linear(tokens)
        split = build.view(projected, build.size(tokens, 0), TOKENS, HEADS, -1)
        heads.append(build.add("Transpose", split, perm=[0, 2, 1, 3]))
    root = build.constant((WIDTH / HEADS) ** 0.5, np.float32)
    key = build.add("Transpose", heads[1], perm=[0, 1, 3, 2])
    scores = build.add("MatMul", build.add("Div", heads[0], root), key)
    mixed = build.add("MatMul", build.add("Softmax", scores, axis=-1), heads[2])
    joined = build.add("Transpose", mixed, perm=[0, 2, 1, 3])
    flat = build.view(joined, build.size(tokens, 0), build.size(tokens, 1), WIDTH)
    return _normalized(build, build.add("Add", tokens, build.linear(flat)))


def _normalized(build: Builder, tokens: str) -> str:
    scale, bias = build.positive("weight", WIDTH), build.weight("bias", WIDTH)
    return build.add("LayerNormalization", tokens, scale, bias, axis=-1)


def _feed_forward(build: Builder, tokens: str) -> str:
    hidden = build.add("Relu", build.linear(tokens))
    dropped = build.add("Identity", build.linear(build.add("Identity", hidden)))
    return _normalized(build, build.add("Add", tokens, dropped))


def _sampling(build: Builder, tokens: str) -> str:
    value = build.add("Transpose", build.linear(tokens), perm=[0, 2, 1])
    image = build.view(value, build.size(tokens, 0), WIDTH, GRID, GRID)
    offsets = build.slice(build.linear(tokens), 0, 2, 2)
    reference = build.add("Sigmoid", build.slice(build.linear(tokens), 2, 4, 2))
    norm = build.add("Cast", build.constant([GRID, GRID]), to=onnx.TensorProto.FLOAT)
    points = build.add("Add", reference, build.add("Div", offsets, norm))
    doubled = build.add("Mul", points, build.constant(2.0, np.float32))
    grid = build.add("Sub", doubled, build.constant(1.0, np.float32))
    grid = build.add("Unsqueeze", grid, build.constant([1]))
    sampled = build.add("GridSample", image, grid, mode="bilinear")
    squeezed = build.add("Squeeze", sampled, build.constant([2]))
    back = build.add("Transpose", squeezed, perm=[0, 2, 1])
    return _normalized(build, build.add("Add", tokens, back))


def _convolution(build: Builder, tokens: str) -> str:
    turned = build.add("Transpose", tokens, perm=[0, 2, 1])
    image = build.view(turned, build.size(tokens, 0), WIDTH, GRID, GRID)
    inner = build.add(
        "Conv",
        image,
        build.weight("weight", WIDTH, WIDTH, 3, 3),
        kernel_shape=[3, 3],
        pads=[1, 1, 1, 1],
    )
    statistics = [
        build.positive("weight", WIDTH),
        build.weight("bias", WIDTH),
        build.weight("running_mean", WIDTH),
        build.positive("running_var", WIDTH),
    ]
    normal = build.add("BatchNormalization", inner, *statistics)
    active = build.add("Relu", build.add("Add", normal, image))
    flat = build.view(active, build.size(image, 0), WIDTH, -1)
    return build.add("Transpose", flat, perm=[0, 2, 1])


def _points(build: Builder, tokens: str) -> str:
    """Reference points: constants all the way, and repeated for every token."""
    steps = build.add(
        "Range",
        build.constant(0.0, np.float32),
        build.constant(float(TOKENS), np.float32),
        build.constant(1.0, np.float32),
    )
    scaled = build.add("Div", steps, build.constant(float(TOKENS), np.float32))
    column = build.add("Unsqueeze", scaled, build.constant([1]))
    shape = build.add("Concat", build.size(tokens, 1), build.size(tokens, 2), axis=0)
    table = build.add("Expand", column, shape)
    row = build.add("Unsqueeze", table, build.constant([0]))
    moved = build.add("Add", tokens, row)
    again = build.add("Add", tokens, row)
    upper = build.constant(0.9, np.float32)
    clipped = build.add("Clip", moved, build.constant(-0.9, np.float32), upper)
    mean = build.add("ReduceMean", again, axes=[-1], keepdims=1)
    kept = build.add("Greater", mean, build.constant(-9.0, np.float32))
    picked = build.add("Where", kept, clipped, again)
    return build.add("Mul", picked, build.constant(1.0, np.float32))


Block = Callable[[Builder, str], str]

BLOCKS: tuple[Block, ...] = (
    _convolution,
    _attention,
    _feed_forward,
    _sampling,
    _points,
)


def synthetic(
    nodes: int, seed: int = 0, blocks: Sequence[Block] = BLOCKS
) -> onnx.ModelProto:
    """Build a graph of at least so many nodes (at most one block more).

    Args:
        nodes: Constant nodes included, as an exporter counts.
        seed: of the weights.
        blocks: which kinds, in turn.
    """
    build = Builder(np.random.default_rng(seed))
    tokens, count = "tokens", 0
    while len(build.nodes) < nodes:
        block = blocks[count % len(blocks)]
        build.scope = f"/stage.{count // 25}/layers.{count}{block.__name__}"
        tokens = block(build, tokens)
        count += 1
    build.nodes.append(onnx.helper.make_node("Identity", [tokens], ["out"], "/Last"))
    shape = [1, TOKENS, WIDTH]
    port = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        build.nodes,
        "synthetic",
        [port("tokens", onnx.TensorProto.FLOAT, shape)],
        [port("out", onnx.TensorProto.FLOAT, shape)],
        build.weights,
    )
    return onnx.helper.make_model(
        graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)], ir_version=8
    )
