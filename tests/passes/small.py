"""Small graphs for the tests of the passes, and what passes make of them."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import onnxruntime

from me2e_compress import graph
from me2e_compress.graph import provenance, static_shape
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.summary import weight_bytes
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.fold_constants import ENTRY_BYTES
from me2e_compress.passes.fuse_basic import FuseBasic
from me2e_compress.passes.import_normalize import ImportNormalize
from tests.support.nets import net

NO_MODULES = Context(ModuleMap("none", ()))
EVERYTHING = ModuleMap.parse(
    '[modules.all]\nrole = "feature"\noptional = ["**"]', "everything"
)
RANDOM = np.random.default_rng(7)


def read(text: str, **weights: Any) -> ir.Model:
    """Read ONNX text, add the weights that it names, stamp every node with its name.

    It is of opset 17 where it does not begin with a version.
    """
    text = text if text.lstrip().startswith("<") else opset(17) + text
    proto = onnx.parser.parse_model(text)
    named = set(re.findall(r"\w+", text))
    for name, array in weights.items():
        if name not in named:
            continue
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


def bare(text: str, arrays: Mapping[str, npt.NDArray[np.float32]]) -> ir.Model:
    """Read a graph whose nodes have neither names nor a past."""
    model = net(text, arrays)
    for node in model.graph:
        node.metadata_props.clear()
    return model


def types_of(model: ir.Model) -> dict[str, str]:
    """Map every operator but Cast to the element type of what it reads first."""
    return {
        node.op_type: node.inputs[0].dtype.name
        for node in model.graph
        if node.op_type != "Cast"
        and node.inputs[0] is not None
        and node.inputs[0].dtype is not None
    }


def casts(model: ir.Model) -> int:
    return sum(node.op_type == "Cast" for node in model.graph)


def opset(version: int) -> str:
    return f'<ir_version: 9, opset_import: ["" : {version}]>\n'


def normal(*shape: int) -> Any:
    return RANDOM.normal(size=shape).astype(np.float32)


def fed(model: ir.Model, seed: int | None = None) -> dict[str, Any]:
    """Draw normal numbers for the inputs of a graph of static shapes."""
    random = RANDOM if seed is None else np.random.default_rng(seed)
    return {
        str(port.name): random.normal(size=static_shape(port) or ()).astype(np.float32)
        for port in model.graph.inputs
    }


def file_bytes(model: ir.Model) -> int:
    """Return what the weights take in a file."""
    return weight_bytes(model) + ENTRY_BYTES * len(model.graph.initializers)


def preserved(
    current: Pass, text: str, within: float = 0.0, **weights: Any
) -> tuple[ir.Model, PassResult]:
    """Apply a pass; outputs of drawn inputs stay within a share of their largest."""
    before, after = read(text, **weights), read(text, **weights)
    result = apply(current, after)
    feeds = fed(before)
    for want, got in zip(compute(before, feeds), compute(after, feeds), strict=True):
        atol = within * np.abs(want).max(initial=0.0) if within else 0.0
        np.testing.assert_allclose(got, want, rtol=0, atol=atol)
    return after, result


def fuse_basic(text: str, left: list[str], **weights: Any) -> ir.Model:
    """Run ``fuse-basic``; compare operators, and values within 1e-4 of the largest."""
    model, _ = preserved(FuseBasic(), text, 1e-4, **weights)
    assert ops(model) == left
    return model


def unstamped(text: str) -> ir.Model:
    """Read ONNX text of opset 17 as it comes in, names and past left out."""
    return ir.from_onnx_text(f'<ir_version: 8, opset_import: ["": 17]>\n{text}')


def normalise(model: ir.Model) -> PassResult:
    """Import a graph of one module, once every node has a name."""
    for node in model.graph.all_nodes():
        node.name = node.name or f"/part/{node.outputs[0].name}"
    return ImportNormalize().run(model, Context(EVERYTHING))


def settled(model: ir.Model) -> bool:
    """Tell whether another import changes nothing."""
    before = graph.digest(model)
    again = ImportNormalize().run(model, Context(EVERYTHING))
    return again.changes == 0 and graph.digest(again.model) == before
