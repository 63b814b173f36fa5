"""A graph of any size with what the original stacks' exports are full of.

The blocks of :mod:`benchmarks.subjects.synthetic`, and between them: packed projections
cut by bounds that are computed from the weight's own shape, convolutions of one weight
over several levels with a normalization behind each, the first attention of a decoder
(between learned queries: all constant), deformable sampling over several levels with
its reshapes, and constants, identities and casts again and again.
"""

import numpy as np
import onnx

from benchmarks.subjects.synthetic import (
    BLOCKS,
    GRID,
    HEADS,
    TOKENS,
    WIDTH,
    Builder,
    synthetic,
)

QUERIES = 300
LEVELS = 3


def _part(build: Builder, packed: str, place: int, rows: int) -> str:
    """One third of a packed weight, as ``chunk`` is exported."""
    size = build.add("Gather", build.add("Shape", packed), build.constant(0), axis=0)
    rounded = build.add("Add", size, build.constant(2))
    step = build.add("Div", rounded, build.constant(3))
    start = build.add("Mul", step, build.constant(place))
    end = build.add("Mul", step, build.constant(place + 1))
    bounds = [
        build.add("Unsqueeze", bound, build.constant([0])) for bound in (start, end)
    ]
    return build.add("Slice", packed, *bounds, build.constant([0]), build.constant([1]))


def _packed(build: Builder, query: str, value: str, tokens: int) -> str:
    """``nn.MultiheadAttention`` of [1, tokens, 32], its projections packed."""
    weight = build.weight("in_proj_weight", 3 * WIDTH, WIDTH)
    bias = build.weight("in_proj_bias", 3 * WIDTH)
    heads = []
    for place, given in enumerate((query, query, value)):
        matrix = build.add("Transpose", _part(build, weight, place, WIDTH), perm=[1, 0])
        projected = build.add("MatMul", given, matrix)
        moved = build.add("Add", projected, _part(build, bias, place, WIDTH))
        split = build.view(moved, build.size(given, 0), tokens, HEADS, -1)
        heads.append(build.add("Transpose", split, perm=[0, 2, 1, 3]))
    key = build.add("Transpose", heads[1], perm=[0, 1, 3, 2])
    depth = build.add("Cast", build.constant(WIDTH // HEADS), to=onnx.TensorProto.FLOAT)
    scaled = build.add("Div", heads[0], build.add("Sqrt", depth))
    mixed = build.add("Softmax", build.add("MatMul", scaled, key), axis=-1)
    joined = build.add("MatMul", build.add("Dropout", mixed), heads[2])
    turned = build.add("Transpose", joined, perm=[0, 2, 1, 3])
    flat = build.view(turned, build.size(query, 0), build.size(query, 1), WIDTH)
    return build.linear(build.add("Identity", flat))


def _packed_attention(build: Builder, tokens: str) -> str:
    attended = _packed(build, tokens, tokens, TOKENS)
    return build.add("Add", tokens, build.add("Dropout", attended))


def _learned_queries(build: Builder, tokens: str) -> str:
    """A decoder's first layer: its self-attention depends on no input."""
    table = build.weight("query_embedding", QUERIES, 2 * WIDTH)
    batch = build.add("Unsqueeze", table, build.constant([0]))
    position = build.slice(batch, 0, WIDTH, 2)
    content = build.slice(batch, WIDTH, 2 * WIDTH, 2)
    query = build.add("Add", content, position)
    attended = build.add("Add", content, _packed(build, query, content, QUERIES))
    key = build.add("Transpose", tokens, perm=[0, 2, 1])
    scores = build.add("Softmax", build.add("MatMul", attended, key), axis=-1)
    back = build.add("Transpose", scores, perm=[0, 2, 1])
    return build.add("Add", tokens, build.linear(build.add("MatMul", back, attended)))


def _shared_convolution(build: Builder, tokens: str) -> str:
    turned = build.add("Transpose", tokens, perm=[0, 2, 1])
    image = build.view(turned, build.size(tokens, 0), WIDTH, GRID, GRID)
    weight = build.weight("weight", WIDTH, WIDTH, 1, 1)
    levels = []
    for _ in range(LEVELS):
        inner = build.add("Conv", image, weight, kernel_shape=[1, 1])
        statistics = [
            build.positive("weight", WIDTH),
            build.weight("bias", WIDTH),
            build.weight("running_mean", WIDTH),
            build.positive("running_var", WIDTH),
        ]
        normal = build.add("BatchNormalization", inner, *statistics)
        levels.append(build.add("Relu", build.add("Identity", normal)))
    total = build.add("Add", build.add("Add", levels[0], levels[1]), levels[2])
    flat = build.view(total, build.size(image, 0), WIDTH, -1)
    return build.add("Add", tokens, build.add("Transpose", flat, perm=[0, 2, 1]))


def _levels(build: Builder, tokens: str) -> str:
    """Deformable attention over several levels: one sampling a level, then a sum."""
    image = build.view(
        build.add("Transpose", build.linear(tokens), perm=[0, 2, 1]),
        build.size(tokens, 0), WIDTH, GRID, GRID,
    )  # fmt: skip
    offsets = build.view(
        build.linear(tokens), build.size(tokens, 0), build.size(tokens, 1), -1, 2
    )
    norm = build.add(
        "Cast",
        build.add("Concat", build.size(image, 3), build.size(image, 2), axis=0),
        to=onnx.TensorProto.FLOAT,
    )
    points = build.add("Sigmoid", build.add("Div", offsets, norm))
    doubled = build.add("Mul", points, build.constant(2.0, np.float32))
    grids = build.add("Sub", doubled, build.constant(1.0, np.float32))
    sampled = []
    for level in range(LEVELS):
        start = build.constant([level])
        grid = build.add(
            "Slice", grids, start, build.constant([level + 1]), build.constant([2])
        )
        found = build.add("GridSample", image, grid, mode="bilinear")
        flat = build.view(found, build.size(tokens, 0), WIDTH, -1)
        sampled.append(build.add("Unsqueeze", flat, build.constant([3])))
    stacked = build.add("Concat", *sampled, axis=3)
    summed = build.add("ReduceMean", stacked, axes=[3], keepdims=0)
    return build.add("Add", tokens, build.add("Transpose", summed, perm=[0, 2, 1]))


EXPORTED = (
    *BLOCKS, _packed_attention, _shared_convolution, _levels, _learned_queries,
)  # fmt: skip


def exported(nodes: int, seed: int = 0) -> onnx.ModelProto:
    """Build a graph of at least so many nodes, Constant nodes included."""
    return synthetic(nodes, seed, EXPORTED)
