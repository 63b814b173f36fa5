"""Does the cost model know where int8 pays? Forms and layers, timed both ways.

    python -m benchmarks.measure.cost_gate [--only PART]
    python -m benchmarks.measure.cost_gate --models OUT [--layers 72] [--seed 0]

The first measures the forms of :mod:`benchmarks.subjects.int8_forms`: a layer by
kernel, stride, group and channels, and what stands between, before and behind layers.
The second draws weighted layers of VAD-tiny, the driver that ships and ResNet-50, as
many of each, cut out of their graphs (after the exact passes) with bias and ReLU. Each
is timed alone, from float to float, for onnxruntime, on one thread, in CPU seconds, in
turn: in float, with every layer in int8, and where rules ``safe`` keep some of several
layers in int8, as they are placed. The model of rule ``cost`` says beforehand, from
shapes, what int8 saves. A choice is wrong where it takes more than a tenth longer than
the best of the three; "always int8" is what it has to beat.

With ``--models`` follow, by module, the MACs that int8 takes over, what it saves and
what its borders cost, as predicted for the whole graph. Under two CPU minutes each;
exporting needs torch.
"""

import argparse
import dataclasses
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from random import Random

import onnx_ir as ir
import onnxruntime

from benchmarks.subjects import resnet50
from benchmarks.subjects.int8_forms import forms
from benchmarks.tools.layer_timing import (
    Layer,
    int8_of,
    plan_of,
    random_model,
    time_graphs,
)
from me2e_compress import graph
from me2e_compress.commands.plan import PreparedGraph
from me2e_compress.graph import static_shape
from me2e_compress.graph.nodes import constant_values
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.costs import Costs
from me2e_compress.runtime.profile import processor
from me2e_compress.shipped.drivers import shipped_model
from me2e_compress.targets import Target
from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.onnxruntime.costs import costs_of
from me2e_compress.targets.onnxruntime.region import end_of, objection
from me2e_compress.targets.weights import biased_end
from models.export import export

WRONG = 1.1
"""A choice that takes so many times as long as the best is wrong; less is noise."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="part of the form's name")
    parser.add_argument("--models", type=Path, help="folder of the exported models")
    parser.add_argument("--layers", type=int, default=72)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    print(f"{processor()}, one thread, onnxruntime {onnxruntime.__version__}\n")
    if chosen.models is None:
        named = [each for each in forms() if chosen.only in each.name]
        show((each.name, random_model(each.text())) for each in named)
        return
    prepared = dict(graphs(chosen.models))
    drawn = Random(chosen.seed)
    rows = []
    for name, ready in prepared.items():
        layers = list(layers_of(ready.model))
        count = min(chosen.layers // len(prepared), len(layers))
        rows += [(name, each) for each in drawn.sample(layers, count)]
    show(
        (f"{name}: {each.op} {each.read} by {each.weight}", each.graph())
        for name, each in rows
    )
    for name, ready in prepared.items():
        modules(name, ready)


def graphs(out: Path) -> Iterator[tuple[str, PreparedGraph]]:
    """Export what is not there, and run the exact passes."""
    out.mkdir(parents=True, exist_ok=True)
    files = {"highway": shipped_model("highway")}
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


@dataclasses.dataclass(frozen=True)
class Row:
    """A graph in float, in int8, and as it is placed.

    Attributes:
        float_s: CPU seconds without int8.
        int8_s: with every layer in int8; None where no layer has a kernel.
        placed_s: as rules ``safe`` place it.
        saves_s: what int8 of every layer should save.
        layers: how many have an int8 kernel, and how many of them are placed in int8.
    """

    float_s: float
    int8_s: float | None = None
    placed_s: float = 0.0
    saves_s: float = 0.0
    layers: tuple[int, int] = (0, 0)

    @property
    def times(self) -> list[float]:
        """All seconds that were measured."""
        both = [self.float_s] if self.int8_s is None else [self.float_s, self.int8_s]
        return [*both, self.placed_s] if self.layers[1] else both

    def is_wrong(self, taken_s: float) -> bool:
        """Return whether a choice takes much longer than the best."""
        return taken_s > WRONG * min(self.times)

    def __str__(self) -> str:
        if self.int8_s is None:
            return f"{self.float_s * 1e6:.0f} | | | | no kernel |"
        count, placed = self.layers
        choice = "float" if not placed else "int8" if placed == count else "mixed"
        choice += f" ({placed} of {count})" if choice == "mixed" else ""
        return (
            f"{self.float_s * 1e6:.0f} | {self.int8_s * 1e6:.0f}"
            f" | {(self.float_s - self.int8_s) * 1e6:+.0f} | {self.saves_s * 1e6:+.0f}"
            f" | {choice} {self.placed_s / self.float_s:.2f}"
            f" | {'wrong' if self.is_wrong(self.placed_s) else ''}"
        )


def measured(model: ir.Model) -> Row:
    """Time a graph, and ask the model of costs and the rules what they would do."""
    plan = plan_of(model)
    nodes = {str(node.outputs[0].name): node for node in model.graph}
    names = [each.output for each in plan.chosen if each.weight is not None]
    layers = [nodes[name] for name in names if objection(nodes[name]) is None]
    if not layers:
        return Row(time_graphs({"float": model})["float"])
    chosen = plan_of(model, "safe{balance=false}", OnnxRuntime().costs)
    int8 = {each.output for each in chosen.chosen} & set(names)
    # one of the two, or a third
    files = {"float": model, "int8": int8_of(model, plan)}
    form = "float" if not int8 else "int8" if len(int8) == len(layers) else "mixed"
    if form == "mixed":
        files[form] = int8_of(model, chosen)
    taken = time_graphs(files)
    saves = net_s(costs_of(model, layers), frozenset(layers))
    counts = (len(layers), len(int8))
    return Row(taken["float"], taken["int8"], taken[form], saves, counts)


def show(graphs: Iterable[tuple[str, ir.Model]]) -> None:
    """Time graphs, and print how often the choice was wrong."""
    rows = list[Row]()
    print("form | float µs | int8 µs | saved | predicted | chosen, of float's | wrong")
    print("---|---:|---:|---:|---:|---|---")
    for name, model in graphs:
        row = measured(model)
        print(f"{name} | {row}", flush=True)
        rows += [row] if row.int8_s is not None else []
    wrong = sum(row.is_wrong(row.placed_s) for row in rows)
    always = sum(row.is_wrong(row.int8_s or 0.0) for row in rows)
    right = sum((row.saves_s > 0) == (row.float_s > (row.int8_s or 0)) for row in rows)
    print(
        f"\n{len(rows)} with an int8 kernel: the choice takes more than a tenth"
        f" longer than the best for {wrong} ({wrong / len(rows):.0%}), always int8 for"
        f" {always};"
        f" the sign of what int8 saves is right for {right} ({right / len(rows):.0%})\n"
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
        scheme=ready.modules.names(),
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
