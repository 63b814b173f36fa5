"""Time of module assignment, import and itemising against the number of nodes.

    python benchmarks/measure/modules.py VAD.onnx

The graph is repeated side by side, weights and inputs shared, to reach the size of
UniAD (24,000 nodes). Times are CPU seconds of this process.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import onnx
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.assign import assign, detect, itemise
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.surgeon import restore
from me2e_compress.passes import Context
from me2e_compress.passes.import_normalize import ImportNormalize


def repeated(source: onnx.ModelProto, times: int) -> ir.Model:
    """Set copies of a graph beside it."""
    result = onnx.ModelProto()
    result.CopyFrom(source)
    shared = {value.name for value in source.graph.input}
    shared |= {tensor.name for tensor in source.graph.initializer} | {""}
    for copy in range(1, times):

        def renamed(name: str, suffix: str = f"_copy{copy}") -> str:
            return name if name in shared else name + suffix

        for node in source.graph.node:
            twin = result.graph.node.add()
            twin.CopyFrom(node)
            twin.name = renamed(node.name)
            twin.input[:] = [renamed(name) for name in node.input]
            twin.output[:] = [renamed(name) for name in node.output]
        for value in source.graph.output:
            port = result.graph.output.add()
            port.CopyFrom(value)
            port.name = renamed(value.name)
    return ir.from_proto(result)


def seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def measure(model: ir.Model, modules: ModuleMap) -> dict[str, float]:
    forgetful = model.clone()
    fresh = ModuleMap.load(modules.name)
    times = {"assign": seconds(lambda: assign(model, fresh))}
    context = Context(modules)
    times["import"] = seconds(lambda: ImportNormalize().run(model, context))
    times["itemise"] = seconds(
        lambda: itemise(model, modules, provenance.module_of, graph.macs)
    )
    times["restore"] = seconds(lambda: restore(forgetful, model, by="bench"))
    return times


def main(path: Path) -> None:
    source = onnx.load(path)
    modules = detect(graph.load(path))
    for times in (1, 3, 6):
        model = repeated(source, times)
        nodes = len(model.graph)
        found = measure(model, modules)
        row = ", ".join(f"{name} {value:.2f} s" for name, value in found.items())
        print(f"{nodes:6d} nodes: {row}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
