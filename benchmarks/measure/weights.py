"""What the rounding of each int8 weight costs its own layer: to nearest, and balanced.

    python -m benchmarks.measure.weights OUT [--subjects tcp-original,highway]
        [--frames 4]

Each layer reads the float graph's tensors and is computed once with its weight and
once with what rounding adds to it, so that nothing else is in the figures. Rows are
kinds of layers by what makes their input, ``Conv 3x3`` standing for every kernel of
more than one pixel; the gain is in dB, mean and least over the layers of a row. All of
them are balanced here: the rule of ``targets/weights.py`` follows from the rows.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx_ir as ir

from benchmarks.subjects import subjects
from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.nodes import array_of, producer_of
from me2e_compress.passes.base import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.session import Session, replay
from me2e_compress.targets.weights import quantize_weight


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--subjects", default="tcp-original,highway")
    parser.add_argument("--frames", type=int, default=4)
    chosen = parser.parse_args()
    for name in chosen.subjects.split(","):
        subject = subjects.make(name, chosen.out, chosen.frames)
        print(
            f"\n{name}\n\nlayer | reads | layers | nearest dB | balanced: mean, least"
        )
        print("---|---|---:|---:|---")
        for row in rows(subject, chosen.frames):
            print(" | ".join(row), flush=True)


def rows(subject: subjects.Subject, count: int) -> Iterator[tuple[str, ...]]:
    """Measure every int8 layer, and yield the rows of the table."""
    model = graph.load(subject.model)
    graph.infer_shapes(model)
    context = Context(ModuleMap.load(str(subject.map)))
    plan = QuantizeInt8(target="tensorrt").plan(model, context)
    axes = {e.output: e.axis for e in plan.chosen if e.weight is not None}
    nodes = [n for n in model.graph if axes.get(str(n.outputs[0].name)) is not None]
    nodes = [node for node in nodes if array_of(node.inputs[1]) is not None]
    kinds = [kind_of(node) for node in nodes]
    names = [
        watch(model, node, axes[str(node.outputs[0].name)]) for node in list(nodes)
    ]
    # The last three outputs of each layer, over all frames
    frames = CalibrationSet(subject.held_out)
    wanted = [name for three in names for name in three]
    power = dict.fromkeys(wanted, 0.0)
    chosen = [frames[at] for at in range(min(count, len(frames)))]
    for found in replay(Session(model, threads=1, frugal=True), chosen, wanted):
        for name in wanted:
            power[name] += float(found[name])
    groups = defaultdict[tuple[str, str], list[tuple[float, float]]](list)
    for kind, (signal, *noises) in zip(kinds, names, strict=True):
        if power[signal]:
            nearest, even = (10 * np.log10(power[signal] / power[e]) for e in noises)
            groups[kind].append((nearest, even - nearest))
    for (layer, reads), pairs in sorted(groups.items()):
        near, gain = np.array(pairs).T
        yield (
            *(layer, reads, str(len(pairs)), f"{near.mean():.1f}"),
            f"{gain.mean():+.1f}, {gain.min():+.1f}",
        )


def kind_of(node: ir.Node) -> tuple[str, str]:
    """Name a layer and what makes its input."""
    weight, made = graph.static_shape(node.inputs[1]), producer_of(node.inputs[0])
    size = ""
    if node.op_type in graph.CONVOLUTIONS:
        size = " 1x1" if np.prod((weight or ())[2:]) == 1 else " 3x3"
    return node.op_type + size, "an input" if made is None else made.op_type


def watch(model: ir.Model, node: ir.Node, axis: int | None) -> list[str]:
    """Add the power of a layer's answer and of both roundings' errors as outputs."""
    stored = array_of(node.inputs[1])
    assert stored is not None
    assert axis is not None
    exact = stored.astype(np.float32)
    flat = exact.reshape(exact.shape[-2:]) if node.op_type == "MatMul" else exact
    side = 1 if node.op_type == "MatMul" else axis
    weights = [exact]
    for balanced in (False, True):
        integers, scales = quantize_weight(flat, side, balanced=balanced)
        sides = [-1 if at == side else 1 for at in range(flat.ndim)]
        error = integers * scales.reshape(sides) - flat
        weights.append(error.reshape(exact.shape).astype(np.float32))
    names = [f"{node.outputs[0].name}_power_{at}" for at in range(len(weights))]
    for name, array in zip(names, weights, strict=True):
        weight = ir.Value(name=f"{name}_of", const_value=ir.tensor(array))
        model.graph.initializers[str(weight.name)] = weight
        layer = ir.node(node.op_type, [node.inputs[0], weight], node.attributes)
        total = ir.node("ReduceSumSquare", [layer.outputs[0]], {"keepdims": 0})
        total.outputs[0].name = name
        total.outputs[0].type = ir.TensorType(ir.DataType.FLOAT)
        total.outputs[0].shape = ir.Shape([])
        model.graph.insert_after(node, [layer, total])
        model.graph.outputs.append(total.outputs[0])
    return names


if __name__ == "__main__":
    main()
