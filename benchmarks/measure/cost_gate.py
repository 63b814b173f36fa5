"""Does the cost model know where int8 pays? Layers drawn by seed, timed both ways.

    python -m benchmarks.measure.cost_gate OUT [--layers 72] [--seed 0]

Weighted layers of VAD-tiny, the driver that ships and ResNet-50, as many of each, are
cut out of their graphs (after the exact passes) with bias and ReLU, and timed alone in
float and in int8 for onnxruntime, in turn, on one thread, in CPU seconds. Alone means
that the input is quantized and the answer dequantized. The model of the rule ``cost``
says the sign beforehand, from shapes; "always int8" is what it has to beat. Then, by
module: the MACs that int8 takes over, what it saves and what its borders cost, as
predicted for the whole graph. Under two CPU minutes; exporting needs torch.
"""

import argparse
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from random import Random

import onnx_ir as ir

from benchmarks.subjects import resnet50
from benchmarks.tools.layer_timing import Layer, time_both
from me2e_compress import graph
from me2e_compress.graph import static_shape
from me2e_compress.graph.nodes import constant_values
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.costs import Costs
from me2e_compress.shipped.drivers import shipped
from me2e_compress.targets import Target
from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.onnxruntime.costs import costs_of
from me2e_compress.targets.onnxruntime.region import end_of, objection
from me2e_compress.targets.weights import biased_end
from me2e_compress.workflows.plan import PreparedGraph
from models.export import export

NEAR = 0.05
"""A difference of that part of the float time is a tie."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--layers", type=int, default=72)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    prepared = dict(graphs(chosen.out))
    drawn = Random(chosen.seed)
    rows = []
    for name, ready in prepared.items():
        found = list(layers_of(ready.model))
        count = min(chosen.layers // len(prepared), len(found))
        rows += [(name, each) for each in drawn.sample(found, count)]
    signs(rows)
    for name, ready in prepared.items():
        modules(name, ready)


def graphs(out: Path) -> Iterator[tuple[str, PreparedGraph]]:
    """Export what is not there, and run the exact passes."""
    out.mkdir(parents=True, exist_ok=True)
    files = {"highway": shipped("highway")}
    for name in ("vad-tiny", "resnet50"):
        files[name] = out / f"{name}.onnx"
    if not files["vad-tiny"].is_file():
        export("vad-tiny", files["vad-tiny"])
    if not files["resnet50"].is_file():
        resnet50.export(files["resnet50"])
    module_map = out / "resnet50.toml"
    module_map.write_text(resnet50.MAP, encoding="utf-8")
    for name, file in files.items():
        own = module_map if name == "resnet50" else None
        yield name, PreparedGraph.of(file, graph.load(file), own)


def layers_of(model: ir.Model) -> Iterator[Layer]:
    """Yield the weighted layers that have an int8 kernel, cut out of a graph."""
    constants = constant_values(model)
    for node in model.graph:
        if objection(node) is not None:
            continue
        read, weight = static_shape(node.inputs[0]), static_shape(node.inputs[1])
        fixed = node.inputs[1] in constants and node.inputs[0] not in constants
        if not fixed or read is None or weight is None:
            continue
        if node.op_type == "MatMul":
            biased = biased_end(node) is not None
            yield Layer("MatMul", read, weight[-2:], bias=biased)
        else:
            yield Layer(
                node.op_type,
                read,
                weight,
                attributes(node),
                bias=len(node.inputs) > 2,
                relu=end_of(node) is not node.outputs[0],
            )


def attributes(node: ir.Node) -> str:
    """Return the integers of a node as ONNX text."""
    found = []
    for name, each in node.attributes.items():
        if each.type == ir.AttributeType.INT:
            found.append(f"{name}={each.as_int()}")
        elif each.type == ir.AttributeType.INTS:
            found.append(f"{name}=[{','.join(map(str, each.as_ints()))}]")
    return ", ".join(found)


def net_s(costs: Costs, int8: Collection[ir.Node]) -> float:
    """Return the seconds saved in all if exactly these layers are int8."""
    paid = sum(border.paid_s(int8) for border in costs.borders)
    return sum(costs.saved_s.get(each, 0.0) for each in int8) - paid


def predicted_s(layer: Layer) -> float:
    """Return what int8 of a layer alone should save, seconds."""
    model = layer.graph()
    nodes = [node for node in model.graph if node.op_type == layer.op]
    return net_s(costs_of(model, nodes), frozenset(nodes))


def signs(rows: list[tuple[str, Layer]]) -> None:
    """Time the layers, and print how often the sign was right."""
    timed = {each: time_both(each) for each in dict.fromkeys(each for _, each in rows)}
    right, clear = Counter[str](), Counter[str]()
    print("| model | layer | float µs | int8 µs | saved | predicted | |")
    print("|---|---|---|---|---|---|---|")
    for name, layer in rows:
        float_s, int8_s = timed[layer]
        saved, expected = float_s - int8_s, predicted_s(layer)
        good = (saved > 0) == (expected > 0)
        right[name] += good
        tie = abs(saved) < NEAR * float_s
        clear[name] += good or tie
        print(
            f"| {name} | {layer.op} {layer.read} by {layer.weight}"
            f" | {float_s * 1e6:.1f} | {int8_s * 1e6:.1f} | {saved * 1e6:+.1f}"
            f" | {expected * 1e6:+.1f} | {'' if good else 'tie' if tie else 'wrong'} |"
        )
    losing = sum(timed[each][0] < timed[each][1] for _, each in rows)
    count = len(rows)
    print(
        f"\n{count} layers ({len(timed)} different), {losing} of them slower in int8"
        f" (always int8 would be right for {(count - losing) / count:.0%}):"
        f" sign right for {right.total()} ({right.total() / count:.0%});"
        f" {clear.total()} ({clear.total() / count:.0%}) where a difference below"
        f" {NEAR:.0%} counts as none; {dict(right)}\n"
    )


def modules(name: str, ready: PreparedGraph) -> None:
    """Print by module what int8 takes over, and what that should save."""
    print(f"| {name} | layers, float, GMACs, saved ms, borders ms |")
    print("|---|---|")
    for module, cell in by_module(ready, OnnxRuntime()).items():
        if cell:
            print(f"| {module} | {cell} |")
    print()


def by_module(ready: PreparedGraph, target: Target) -> dict[str, str]:
    """Describe what each module would be, alone in int8 on a target."""
    step = QuantizeInt8(
        modules=ready.modules.names(),
        target="tensorrt",
        rules="safe{without=[cost]}",
    )
    plan = step.plan(ready.model, Context(ready.modules))
    nodes = {str(node.outputs[0].name): node for node in ready.model.graph}
    cells = dict.fromkeys(ready.modules.names(), "")
    for module in cells:
        layers = [
            nodes[each.output]
            for each in plan.chosen
            if each.module == module and each.weight is not None
        ]
        costs = target.costs(ready.model, layers)
        if not layers or costs is None:
            continue
        kept = frozenset(layers) - costs.losses(layers).keys()
        saved = sum(costs.saved_s.get(each, 0.0) for each in kept)
        macs = sum(graph.macs(each) or 0 for each in kept)
        cells[module] = (
            f"{len(layers)}, {len(layers) - len(kept)}, {macs / 1e9:.2f},"
            f" {saved * 1e3:.2f}, {(saved - net_s(costs, kept)) * 1e3:.2f}"
        )
    return cells


if __name__ == "__main__":
    main()
