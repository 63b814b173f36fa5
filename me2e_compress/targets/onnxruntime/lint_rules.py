"""Lint rules: can onnxruntime's CPU run a graph, and its int8 fast?"""

from collections.abc import Iterator

import onnx
import onnx_ir as ir

from me2e_compress.graph import (
    CONVOLUTIONS,
    WEIGHTED,
    array_of,
    is_standard,
    nodes_of,
    opset_of,
    producer_of,
)
from me2e_compress.graph.validity import ORIGINAL_DOMAIN
from me2e_compress.operators import find
from me2e_compress.runtime.kernel_types import remedy, without_kernel
from me2e_compress.runtime.runnable import known_operators
from me2e_compress.targets.base import (
    LintFinding,
    LintRule,
    error,
    name_of,
    of_opset,
    valid,
    warning,
)
from me2e_compress.targets.onnxruntime.int8_rewrites import int8_rewrites
from me2e_compress.targets.onnxruntime.region import never_negative
from me2e_compress.targets.quantized import QUANTIZE, is_dequantized


def opset(model: ir.Model) -> Iterator[LintFinding]:
    """Find opsets that ONNX has not released."""
    found, newest = opset_of(model), onnx.defs.onnx_opset_version()
    if found > newest:
        yield error("opset", None, f"opset {found}, the newest known is {newest}")


def operators(model: ir.Model) -> Iterator[LintFinding]:
    """Find operators that have neither a kernel nor a function in the file."""
    known = known_operators()
    for node in nodes_of(model):
        domain = "" if is_standard(node) else node.domain
        name = f"{node.domain or 'ai.onnx'}::{node.op_type}"
        if (domain, node.op_type) in known or node.op_identifier() in model.functions:
            continue
        said = f"{name} has no kernel and no local function"
        yield error("operator", node, f"{said}{_remedy(node)}")


def _remedy(node: ir.Node) -> str:
    """Name the pass that helps a fused operator: functions need a domain."""
    if find(node) is None:
        return ""
    if is_standard(node) or ORIGINAL_DOMAIN in node.metadata_props:
        return ": expand-operators writes its body"
    return ": attach-bodies writes one, expand-operators the body in its place"


def kernels(model: ir.Model) -> Iterator[LintFinding]:
    """Find operators that have a kernel, but none for these element types."""
    for node, missing in without_kernel(model):
        yield error("kernel", node, f"{missing}{remedy(model, missing)}")


def signed_activations(model: ir.Model) -> Iterator[LintFinding]:
    """Find layers that read int8: only uint8 by int8 has fast kernels.

    Measured on AVX512-VNNI: int8 by int8 products run at 34 to 91 GOP/s, uint8 by int8
    at 850 to 1600.
    """
    for node in _layers(model):
        value = node.inputs[0]
        if is_dequantized(value) and _reads(value) == ir.DataType.INT8:
            yield warning(
                "signed-activation", node, "reads int8, the fast kernels read uint8"
            )


def unanswered(model: ir.Model) -> Iterator[LintFinding]:
    """Find int8 convolutions whose output is not quantized: they run in float."""
    for node in _layers(model):
        quantized = all(map(is_dequantized, node.inputs[:2]))
        if node.op_type not in CONVOLUTIONS or not quantized:
            continue
        value = node.outputs[0]
        # Look past a fused Relu or Clip.
        readers = list(value.consumers())
        if len(readers) == 1 and readers[0].op_type in ("Relu", "Clip"):
            readers = list(readers[0].outputs[0].consumers())
        if not any(reader.op_type == QUANTIZE for reader in readers):
            yield warning(
                "float-answer", node, "no QuantizeLinear follows: it runs in float"
            )


def padded_pools(model: ir.Model) -> Iterator[LintFinding]:
    """Find a Pad of zeros before a MaxPool: onnxruntime 1.31 computes it wrongly.

    Its Pad fusion turns the zeros into the pool's own padding, which is minus infinity;
    inputs that are never negative give the same result. Our own sessions disable it.
    """
    for node in nodes_of(model):
        pad = producer_of(node.inputs[0]) if node.op_type == "MaxPool" else None
        if pad is None or not is_standard(pad) or not _pads_with_zeros(pad):
            continue
        # Without negative values the result is the same.
        image = pad.inputs[0]
        if image is None or not never_negative(image):
            yield LintFinding(
                "wrong",
                "padded-pool",
                name_of(node),
                f"reads the zeros of Pad {pad.name!r}: onnxruntime's Pad fusion makes "
                "them minus infinity; open it with disabled_optimizers=['Pad_Fusion']",
            )


def _pads_with_zeros(pad: ir.Node) -> bool:
    if pad.op_type != "Pad" or len(list(pad.outputs[0].consumers())) != 1:
        return False
    mode = pad.attributes.get("mode")
    if mode is not None and mode.as_string() != "constant":
        return False
    filled = pad.inputs[2] if len(pad.inputs) > 2 else None
    value = None if filled is None else array_of(filled)
    return filled is None or (value is not None and not value.any())


def _layers(model: ir.Model) -> Iterator[ir.Node]:
    for node in nodes_of(model):
        if is_standard(node) and node.op_type in WEIGHTED:
            yield node


def _reads(value: ir.Value | None) -> ir.DataType | None:
    node = producer_of(value)
    integers = None if node is None else node.inputs[0]
    return None if integers is None else integers.dtype


RULES: tuple[LintRule, ...] = (
    valid,
    of_opset,
    opset,
    operators,
    kernels,
    signed_activations,
    unanswered,
    padded_pools,
    int8_rewrites,
)
