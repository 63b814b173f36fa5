"""Small graphs for the tests of the exact passes."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
import onnxruntime

from me2e_compress import graph
from me2e_compress.graph import provenance
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.passes.base import Context, Pass, PassResult

NO_MODULES = Context(ModuleMap("none", ()))


def read(text: str, **weights: Any) -> ir.Model:
    """Read ONNX text, add weights by name, and stamp every node with its name."""
    proto = onnx.parser.parse_model(text)
    for name, array in weights.items():
        tensor = ir.tensor(np.asarray(array), name=name)
        proto.graph.initializer.append(ir.to_proto(tensor))
    model = ir.from_proto(proto)
    for index, node in enumerate(model.graph.all_nodes()):
        node.name = node.name or f"n{index}"
        provenance.stamp(node, provenance.Provenance("all", (node.name,)))
    return model


def ops(model: ir.Model) -> list[str]:
    return [node.op_type for node in model.graph]


def apply(current: Pass, model: ir.Model) -> PassResult:
    """Run a pass; hold it to its contract: past, interface, claim, idempotence."""
    graph.infer_shapes(model)
    before, ports = graph.digest(model), graph.interface(model)
    result = current.run(model, NO_MODULES)
    graph.infer_shapes(result.model)
    after = graph.digest(result.model)
    assert (after != before) == bool(result.changes)
    assert provenance.missing(result.model) == []
    assert graph.interface(result.model) == ports
    assert current.run(result.model.clone(), NO_MODULES).changes == 0
    assert graph.digest(result.model) == after
    return result


def compute(model: ir.Model, feeds: Mapping[str, Any]) -> list[Any]:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.graph_optimization_level = level
    session = onnxruntime.InferenceSession(
        ir.to_proto(model).SerializeToString(),
        options,
        providers=["CPUExecutionProvider"],
    )
    return list(session.run(None, dict(feeds)))
