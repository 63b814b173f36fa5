"""Lint rules: what OpenVINO computes otherwise than a graph says, or in float.

Each was measured on a small valid graph with OpenVINO 2026.4.1, on an AMD EPYC (Zen 4),
where onnxruntime 1.32 and the nodes agree. Which operators its frontend has, only
opening a graph tells.
"""

from collections.abc import Iterator

import onnx_ir as ir

from me2e_compress.graph import array_of, input_at, is_standard, nodes_of
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, maker
from me2e_compress.graph.shapes import CONVOLUTIONS
from me2e_compress.targets import (
    LintFinding,
    LintRule,
    divided_grids,
    of_opset,
    rule_of_nodes,
    valid,
    warning,
)
from me2e_compress.targets.quantized import (
    DEQUANTIZE,
    QUANTIZE,
    stored_type,
)


def is_joined(value: ir.Value | None) -> bool:
    """Return whether a Concat made a value, but for its layout."""
    while (moved := maker(value, *LAYOUT_OPERATORS)) is not None:
        value = moved.inputs[0]
    return maker(value, "Concat") is not None


@rule_of_nodes("zero-point", "wrong")
def _zero_point(node: ir.Node) -> Iterator[str]:
    """Find what forgets a zero point, which its low-precision passes move behind it."""
    reader = maker(node.inputs[0], DEQUANTIZE) if node.inputs else None
    zero = None if reader is None else array_of(input_at(reader, 2))
    if zero is None or not zero.any() or not is_standard(node):
        return
    read = node.attributes
    counted = read.get_int("count_include_pad", 0) and any(read.get_ints("pads", ()))
    if node.op_type == "AveragePool" and counted:
        yield "its pads count as code 0, not as the number 0: its border is wrong"
    # Others compute in integers where a pair follows
    if all(reader.op_type != QUANTIZE for reader in node.outputs[0].consumers()):
        return
    if node.op_type == "Pad" and read.get_string("mode", "constant") == "constant":
        yield "it pads with the value plus zero point times scale"
    if node.op_type == "ReduceSum":
        yield "the zero point is taken off once, not once a summand"


@rule_of_nodes("attribute", "wrong")
def _attribute(node: ir.Node) -> Iterator[str]:
    """Find attributes that OpenVINO ignores or reads in its own way."""
    if not is_standard(node):
        return
    read = node.attributes
    if node.op_type == "Resize" and read.get_int("antialias", 0) > 0:
        yield "antialias is ignored"
    counted = read.get_int("count_include_pad", 0) * read.get_int("ceil_mode", 0)
    if node.op_type == "AveragePool" and counted:
        yield "with ceil_mode it divides by cells that are not there"


@rule_of_nodes("type", "wrong")
def _type(node: ir.Node) -> Iterator[str]:
    """Find what is computed in another type."""
    if node.op_type != "Constant" and node.outputs[0].dtype == ir.DataType.DOUBLE:
        yield "float64 is computed in float32"


@rule_of_nodes("int8-behind-concat", "wrong")
def _joined(node: ir.Node) -> Iterator[str]:
    """Find convolutions that read a signed pair behind a Concat: 11 dB on two floats.

    Uint8 with any zero point is right there, and so is a MatMul.
    """
    reader = maker(node.inputs[0], DEQUANTIZE) if node.inputs else None
    if reader is None or node.op_type not in CONVOLUTIONS:
        return
    quantizer = maker(reader.inputs[0], QUANTIZE)
    if quantizer is None or stored_type(quantizer) != ir.DataType.INT8:
        return
    if is_joined(quantizer.inputs[0]):
        yield "it reads int8 behind a Concat: wrong by more than int8; uint8 is right"


def _functions(model: ir.Model) -> Iterator[LintFinding]:
    """Find calls of functions in the file, which OpenVINO does not read."""
    called = [n for n in nodes_of(model) if n.op_identifier() in model.functions]
    if called:
        message = (
            f"{len(called)} nodes call functions of the file, which OpenVINO alone does"
            " not read: --provider openvino runs them by kernels; without fusions (-r"
            " full) there are none"
        )
        yield warning("function", called[0], message)


RULES: tuple[LintRule, ...] = (
    valid, of_opset, divided_grids, _functions, _zero_point, _attribute, _type,
    _joined,
)  # fmt: skip
