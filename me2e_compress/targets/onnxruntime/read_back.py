"""Open a graph in onnxruntime, and find int8 layers that run in float there."""

from collections.abc import Iterator

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.quantization.plan import plan_of
from me2e_compress.runtime.optimized import optimized, origins, with_unique_names
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets.base import LintFinding, error, warning
from me2e_compress.targets.onnxruntime.convert import int8_layers

_FLOAT_KERNELS = frozenset(
    {
        "Conv", "ConvTranspose", "FusedConv", "FusedGemm", "FusedMatMul", "Gemm",
        "MatMul", "NhwcFusedConv",
    }
)  # fmt: skip
"""Layers in the optimized graph that compute in float."""


def read_back(model: ir.Model, provider: Provider = CPU) -> Iterator[LintFinding]:
    """Find layers that are int8 in a graph, but float in the session that runs it.

    onnxruntime looks for int8 after its first fusions, and for complete patterns: a
    bias, a ReLU or a second reader of a layer's output hides the layer.
    """
    source = with_unique_names(model)
    try:
        found = optimized(source, provider)
    except GraphError as refusal:
        yield error("refused", None, str(refusal))
        return
    # Layers with only int8 weights are meant to run in float.
    plan = plan_of(model)
    meant = set() if plan is None else {each.output for each in plan.weight_only}
    known = origins(source, found)
    for node in int8_layers(found, _FLOAT_KERNELS):
        layer = _layer_of(known.get(str(node.name), node))
        if layer.outputs[0].name not in meant:
            yield warning("float-kernel", layer, _what(layer, node.op_type))


def _layer_of(node: ir.Node) -> ir.Node:
    """Return the layer of a fused node: itself, or the input of its ReLU or bias."""
    maker = graph.producer_of(node.inputs[0])
    if node.op_type in _FLOAT_KERNELS or maker is None:
        return node
    return maker if maker.op_type in _FLOAT_KERNELS else node


def _what(layer: ir.Node, kernel: str) -> str:
    """Describe the kernel and the readers of its output, which are often the reason."""
    readers = dict.fromkeys(each.op_type for each in layer.outputs[0].consumers())
    told = f"; {' and '.join(readers)} reads it" if readers else ""
    return f"reads int8, and runs in float, as {kernel}{told}"
