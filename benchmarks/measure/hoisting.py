"""What ``hoist-linear`` and ``flatten-matmul`` save.

    python -m benchmarks.measure.hoisting

Parts of VAD-tiny as they are exported and behind the pass: the keys of the motion
decoder, motion's attention to the map as the original code has it (keys and values
written for every agent and mode), the sampling places of the spatial cross attention
(10,000 queries for six cameras), the rows of a planner of which one is stored, and the
points of BEV cells in every camera's image. CPU time of onnxruntime on two threads, the
least of rounds that alternate. First, how long ``hoist-linear`` itself takes on
graphs of more and more products of repeated rows.
"""

import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import onnxruntime

from benchmarks.tools.processes import in_turn
from me2e_compress import graph
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.passes.base import Context
from me2e_compress.passes.flatten_matmul import FlattenMatmul
from me2e_compress.passes.hoist_linear import HoistLinear

ROUNDS = 10
AGENTS, TOKENS, HEADS, CHANNELS = 1800, 101, 8, 32
WIDTH = HEADS * CHANNELS
KEYS = f"""<ir_version: 8, opset_import: ["" : 17]>
keys (float[1,{TOKENS},{WIDTH}] map, float[{AGENTS},{TOKENS},2] position,
      float[{AGENTS},{HEADS},1,{CHANNELS}] q) => (float[A,B,C,D] scores) {{
    linear = MatMul(position, embed)  wide = Add(linear, start)  query = Add(map, wide)
    product = MatMul(query, weight)  keys = Add(product, bias)
    split = Reshape(keys, heads)  turned = Transpose<perm = [0, 2, 3, 1]>(split)
    scores = MatMul(q, turned)
}}"""
CAMERAS, HEIGHTS, CELLS = 6, 4, 10_000
POINTS = f"""<ir_version: 8, opset_import: ["" : 17]>
points (float[{CAMERAS},1,1,4,4] matrices) => (float[A,B,C,D,E] places) {{
    places = MatMul(matrices, points)
}}"""
ATTENTION = f"""<ir_version: 8, opset_import: ["" : 17]>
attention (float[1,1,{TOKENS - 1},{WIDTH}] map, float[{TOKENS},{AGENTS},2] position,
           float[{AGENTS * HEADS},1,{CHANNELS}] q,
           float[{AGENTS * HEADS},1,{TOKENS}] far) => (float[A,B,C] y) {{
    many = Tile(map, times)  flat = Reshape(many, tiled)
    more = Concat<axis = 1>(flat, empty)  lanes = Transpose<perm = [1, 0, 2]>(more)
    linear = MatMul(position, embed)  wide = Add(linear, start)
    query = Add(lanes, wide)  product = MatMul(query, weight)
    keys = Add(product, bias)  split = Reshape(keys, heads)
    turned = Transpose<perm = [1, 2, 0]>(split)  scores = MatMul(q, turned)
    seen = Add(scores, far)  shares = Softmax<axis = -1>(seen)
    rows = MatMul(lanes, weight)  values = Add(rows, bias)
    cut = Reshape(values, heads)  moved = Transpose<perm = [1, 0, 2]>(cut)
    y = MatMul(shares, moved)
}}"""
"""As VAD's motion reads the map: see :mod:`benchmarks.subjects.original_patterns`."""
CAMERAS, CELLS = 6, 10_000
QUERIES = f"""<ir_version: 8, opset_import: ["" : 17]>
queries (float[1,{CELLS},{WIDTH}] query, float[1,{CELLS},{WIDTH}] position,
         float[{CAMERAS},{CELLS},1,1,4,2] points)
    => (float[{CAMERAS},{CELLS},8,1,8,2] places, float[{CAMERAS},{CELLS},8,1,8] shares)
{{
    single = Unsqueeze(query, one)  tiled = Tile(single, times)
    rows = Reshape(tiled, flat)  both = Add(rows, position)
    product = MatMul(both, wo)  linear = Add(product, bo)
    offsets = Reshape(linear, eight)  steps = Div(offsets, size)
    pillars = Reshape(steps, four)  at = Add(points, pillars)
    places = Reshape(at, eight)
    scores = MatMul(both, ww)  biased = Add(scores, bw)  heads = Reshape(biased, split)
    soft = Softmax<axis = -1>(heads)  shares = Reshape(soft, levels)
}}"""
PLANNER = f"""<ir_version: 8, opset_import: ["" : 17]>
planner (float[1,100,{WIDTH}] agents) => (float[101,300,{WIDTH}] keys) {{
    tiled = Tile(agents, times)  rows = Concat<axis = 1>(tiled, ego)
    turned = Transpose<perm = [1, 0, 2]>(rows)
    product = MatMul(turned, weight)  keys = Add(product, bias)
}}"""
Arrays = Mapping[str, npt.NDArray[Any]]


def normal(*shape: int) -> npt.NDArray[np.float32]:
    numbers = np.random.default_rng(0).normal(size=shape) / 10
    return numbers.astype(np.float32)


def model_of(text: str, weights: Arrays) -> ir.Model:
    proto = onnx.parser.parse_model(text)
    for name, array in weights.items():
        proto.graph.initializer.append(onnx.numpy_helper.from_array(array, name))
    model = ir.from_proto(proto)
    for index, node in enumerate(model.graph):
        node.name = f"n{index}"
        provenance.stamp(node, provenance.Provenance("all", (node.name,)))
    graph.infer_shapes(model)
    return model


def hoisted(text: str, weights: Arrays) -> ir.Model:
    model = model_of(text, weights)
    context = Context(ModuleMap.whole())
    model = HoistLinear().run(model, context).model
    graph.infer_shapes(model)
    return model


def session_of(model: ir.Model) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 2
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    data = ir.to_proto(model).SerializeToString()
    return onnxruntime.InferenceSession(
        data, options, providers=["CPUExecutionProvider"]
    )


def milliseconds(models: list[ir.Model], feeds: Arrays, runs: int) -> list[float]:
    """Time models in turns: the least CPU time of a run of each."""

    def work(session: onnxruntime.InferenceSession) -> None:
        for _ in range(runs):
            session.run(None, dict(feeds))

    works = {str(at): partial(work, session_of(m)) for at, m in enumerate(models)}
    taken = in_turn(works, ROUNDS).values()
    return [min(seconds) / runs * 1e3 for seconds in taken]


def show_keys() -> None:
    weights = {
        "embed": normal(2, WIDTH), "start": normal(WIDTH),
        "weight": normal(WIDTH, WIDTH), "bias": normal(WIDTH),
        "heads": np.array((AGENTS, TOKENS, HEADS, CHANNELS)),
    }  # fmt: skip
    feeds = {
        "map": normal(1, TOKENS, WIDTH),
        "position": normal(AGENTS, TOKENS, 2),
        "q": normal(AGENTS, HEADS, 1, CHANNELS),
    }
    compare("keys of the motion decoder", KEYS, weights, feeds)


def show_attention() -> None:
    weights = {
        "times": np.array((1, AGENTS, 1, 1)),
        "tiled": np.array((AGENTS, TOKENS - 1, WIDTH)),
        "empty": np.zeros((AGENTS, 1, WIDTH), np.float32),
        "embed": normal(2, WIDTH), "start": normal(WIDTH),
        "weight": normal(WIDTH, WIDTH), "bias": normal(WIDTH),
        "heads": np.array((TOKENS, AGENTS * HEADS, CHANNELS)),
    }  # fmt: skip
    feeds = {
        "map": normal(1, 1, TOKENS - 1, WIDTH),
        "position": normal(TOKENS, AGENTS, 2),
        "q": normal(AGENTS * HEADS, 1, CHANNELS),
        "far": normal(AGENTS * HEADS, 1, TOKENS),
    }
    compare("motion's attention to the map, original", ATTENTION, weights, feeds)


def show_cameras() -> None:
    lead = (CAMERAS, CELLS, HEADS)
    weights = {
        "one": np.array([1]), "times": np.array((1, CAMERAS, 1, 1)),
        "flat": np.array((CAMERAS, CELLS, WIDTH)), "eight": np.array((*lead, 1, 8, 2)),
        "four": np.array((*lead, 2, 4, 2)), "split": np.array((*lead, 8)),
        "levels": np.array((*lead, 1, 8)),
        "size": np.array((20, 12), np.float32).reshape(1, 1, 1, 1, 1, 2),
        "wo": normal(WIDTH, 128), "bo": normal(128),
        "ww": normal(WIDTH, 64), "bw": normal(64),
    }  # fmt: skip
    feeds = {
        "query": normal(1, CELLS, WIDTH), "position": normal(1, CELLS, WIDTH),
        "points": normal(CAMERAS, CELLS, 1, 1, 4, 2),
    }  # fmt: skip
    compare("sampling places for six cameras", QUERIES, weights, feeds)


def show_planner() -> None:
    weights = {
        "times": np.array((300, 1, 1)), "ego": np.repeat(normal(1, 1, WIDTH), 300, 0),
        "weight": normal(WIDTH, WIDTH), "bias": normal(WIDTH),
    }  # fmt: skip
    feeds = {"agents": normal(1, 100, WIDTH)}
    compare("100 repeated rows and a stored one", PLANNER, weights, feeds)


def compare(name: str, text: str, weights: Arrays, feeds: Arrays) -> None:
    models = [model_of(text, weights), hoisted(text, weights)]
    before, after = milliseconds(models, feeds, 1)
    graph.infer_shapes(models[1])
    first, last = (
        sum(graph.macs(node) or 0 for node in model.graph) / 1e9 for model in models
    )
    print(
        f"{name}: {first:.3f} GMACs in {before:.1f} ms,"
        f" hoisted {last:.3f} GMACs in {after:.1f} ms"
    )


def show_points() -> None:
    weights = {"points": normal(1, HEIGHTS, CELLS, 4, 1)}
    flat = model_of(POINTS, weights)
    FlattenMatmul().run(flat, Context(ModuleMap.whole()))
    feeds = {"matrices": normal(CAMERAS, 1, 1, 4, 4)}
    before, after = milliseconds([model_of(POINTS, weights), flat], feeds, 1)
    each = before / (CAMERAS * HEIGHTS * CELLS) * 1e6
    print(
        f"points in cameras: {before:.1f} ms ({each:.0f} ns a point), flattened"
        f" {after:.1f} ms"
    )


def show_pass(count: int) -> None:
    body = "z0 = Relu(x0)  " + "".join(
        f"t{at} = Expand(x{at}, shape)  r{at} = Relu(t{at})  y{at} = MatMul(r{at}, w)"
        f"  z{at + 1} = Add(z{at}, y{at})  "
        for at in range(count)
    )
    inputs = ", ".join(f"float[1,4,16] x{at}" for at in range(count))
    outputs = f"float[64,4,16] z{count}"
    opset = '<ir_version: 8, opset_import: ["" : 17]>'
    text = f"{opset}\nproducts ({inputs}) => ({outputs}) {{ {body} }}"
    model = model_of(text, {"w": normal(16, 16), "shape": np.array((64, 4, 16))})
    start = time.process_time()
    changes = HoistLinear().run(model, Context(ModuleMap.whole())).changes
    taken = time.process_time() - start
    print(f"{changes} rewrites in {4 * count} nodes: {taken:.2f} CPU s")


if __name__ == "__main__":
    for products in (400, 800, 1600):
        show_pass(products)
    show_keys()
    show_points()
    show_attention()
    show_cameras()
    show_planner()
