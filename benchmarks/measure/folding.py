"""Exact passes beside onnxsim and onnxslim, on graphs like the original exports.

    python -m benchmarks.measure.folding            # 8,000 and 30,000 nodes
    python -m benchmarks.measure.folding --price    # what a node, a MAC, a byte take

Each tool works in a process of its own, from file to file: CPU seconds of the whole
process, imports included, and its largest resident set. Outputs are compared with the
original's on one random frame.
"""

import argparse
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime

from benchmarks.measure.exact_passes import error
from benchmarks.subjects.exported import exported
from benchmarks.subjects.synthetic import TOKENS, WIDTH
from benchmarks.tools.processes import in_turn
from benchmarks.tools.simplifiers import Job, measure
from me2e_compress import graph

TOOLS = ("ours", "onnxsim", "onnxslim")
SIZES = (8_000, 30_000)


def outputs(path: Path) -> list[Any]:
    tokens = np.random.default_rng(1).normal(size=(1, TOKENS, WIDTH))
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return list(session.run(None, {"tokens": tokens.astype(np.float32)}))


def compare(count: int) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        source = Path(scratch) / "source.onnx"
        model = exported(count)
        onnx.save(model, source)
        print(f"\n{len(model.graph.node):,} nodes, {source.stat().st_size:,} bytes")
        print(f"{'':9} {'nodes':>6} {'weights':>11} {'CPU s':>6} {'RSS MB':>7}  error")
        want = outputs(source)
        for tool in TOOLS:
            target = Path(scratch) / f"{tool}.onnx"
            taken = measure(tool, Job(source, target, "", None))
            off = error(want, outputs(target))
            made = graph.size(graph.load(target))
            print(
                f"{tool:9} {made.nodes:6} {made.weight_bytes:11,}"
                f" {taken.startup_s + taken.cpu_s:6.1f} {taken.peak_mb:7.0f}  {off:.1e}"
            )


def price() -> None:
    """Time many small nodes, one large product and one large sum."""
    port, kind = onnx.helper.make_tensor_value_info, onnx.TensorProto.FLOAT

    def seconds(op: str, depth: int, shape: list[int]) -> float:
        names = ["x", *(f"v{i}" for i in range(depth))]
        made = [
            onnx.helper.make_node(op, [names[i], "w"], [names[i + 1]])
            for i in range(depth)
        ]
        ports = [port("x", kind, shape), port("w", kind, shape)]
        body = onnx.helper.make_graph(made, "g", ports, [port(names[-1], kind, shape)])
        model = onnx.helper.make_model(
            body, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8
        )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 2
        session = onnxruntime.InferenceSession(model.SerializeToString(), options)
        feeds = {name: np.ones(shape, np.float32) for name in ("x", "w")}
        runs = {op: partial(session.run, None, feeds)}
        (taken,) = in_turn(runs, 7, time.perf_counter).values()
        return min(taken) / depth

    node_s = seconds("Add", 1000, [4])
    product_s, sum_s = seconds("MatMul", 4, [1024, 1024]), seconds("Add", 8, [1 << 22])
    print(f"a node       {1e6 * node_s:8.2f} us")
    print(f"a product    {1024**3 / product_s / 1e9:8.1f} GMAC/s")
    print(f"a sum        {3 * (4 << 22) / sum_s / 1e9:8.1f} GB/s")
    print(f"MACs a node  {1024**3 / product_s * node_s:10,.0f}")
    print(f"bytes a node {3 * (4 << 22) / sum_s * node_s:10,.0f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--price", action="store_true")
    given = parser.parse_args()
    if given.price:
        price()
    else:
        for count in given.nodes:
            compare(count)


if __name__ == "__main__":
    main()
