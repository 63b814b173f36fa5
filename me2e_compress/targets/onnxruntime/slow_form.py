"""Tell a quantized file that onnxruntime's CPU runs slower than float: TensorRT's form.

TensorRT wants pairs where a layer reads. onnxruntime wants one behind a layer, too: it
computes in integers what stands between two pairs, and everything else in float, each
pair in a kernel of its own. Measured with 1.31.1 on one core of an AMD EPYC (Zen 3):
convolutions take 1.26 of float's time with pairs on their inputs alone and 0.52 between
two, products with a bias 1.14 to 1.25 and 0.52 to 0.58. Signed activations become
unsigned when a session opens, so the sign alone costs nothing.
"""

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import (
    CONVOLUTIONS,
    WEIGHTED,
    array_of,
    bias_of,
    input_at,
    is_standard,
    nodes_of,
)
from me2e_compress.graph.nodes import maker
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets.onnxruntime.convert import dequantizer_of, reads_integers
from me2e_compress.targets.onnxruntime.kernels import is_clip_at_zero
from me2e_compress.targets.quantized import QUANTIZE, is_dequantized

_PASSED = frozenset(
    {"MaxPool", "Reshape", "Slice", "Squeeze", "Transpose", "Unsqueeze"}
)
"""Operators that onnxruntime moves a QuantizeLinear in front of (QDQPropagation)."""
_LEAST = {ir.DataType.INT8: -128, ir.DataType.UINT8: 0}
"""Types of activations that there are integer kernels for, with their least number."""
_OF_TENSORRT = (ir.DataType.INT8, ir.DataType.FLOAT8E4M3FN)
"""Types of activations that TensorRT takes, with zero points 0."""


def slow_here(model: ir.Model, provider: Provider = CPU) -> str | None:
    """Say that a quantized graph is slow in onnxruntime's CPU, and what is fast.

    That is so where half or more of the layers whose operands both come through a pair
    gain nothing by it, whoever placed the pairs. None for other graphs, and where
    another provider runs it.
    """
    if provider.native != CPU.native:
        return None
    layers = [
        node
        for node in nodes_of(model)
        if is_standard(node) and node.op_type in WEIGHTED and reads_integers(node)
    ]
    slow = [node for node in layers if not _is_fast(node)]
    if not slow or 2 * len(slow) < len(layers):
        return None
    form, remedy = "a form that is", ""
    read = [pair for node in slow if (pair := dequantizer_of(node.inputs[0]))]
    kinds = {_kind_of(pair) for pair in read}
    if kinds.issubset(_OF_TENSORRT) and not any(_zeros_of(pair).any() for pair in read):
        form = "TensorRT's form,"
        if kinds == {ir.DataType.INT8}:
            remedy = ", --passes import-normalize,lower-int8 makes it of this file"
    return (
        f"it is quantized in {form} slow in onnxruntime's CPU (no fast kernel for"
        f" {len(slow)} of {len(layers)} layers): compress --target onnxruntime writes"
        f" what is fast here{remedy}"
    )


def _is_fast(layer: ir.Node) -> bool:
    """Return whether onnxruntime has a kernel for a layer that beats float."""
    pair, end, bias = dequantizer_of(layer.inputs[0]), layer.outputs[0], bias_of(layer)
    typed = pair is not None and _is_looked_at(pair)
    if layer.op_type == "ConvTranspose" or not typed or _is_activation(layer.inputs[1]):
        return False
    # a MatMul and its bias become one Gemm before pairs are looked for
    merged, readers = False, list(end.consumers())
    if layer.op_type == "MatMul" and [each.op_type for each in readers] == ["Add"]:
        merged = any(array_of(value) is not None for value in readers[0].inputs)
        end = readers[0].outputs[0] if merged else end
    ends = _ends(end, takes_relu=not merged)
    pairs = [each for each in ends if each.op_type == QUANTIZE]
    if ends and len(pairs) == len(ends):
        return True
    # a product may answer in float, unless a ReLU or a pair was to be taken in
    biased = merged or (bias is not None and not is_dequantized(bias))
    return layer.op_type not in CONVOLUTIONS and not biased and not pairs


def _is_looked_at(pair: ir.Node) -> bool:
    """Return whether sessions take a pair in: of uint8, or int8 with a zero point."""
    kind = _kind_of(pair)
    return kind in _LEAST and (kind == ir.DataType.UINT8 or len(pair.inputs) > 2)


def _is_activation(value: ir.Value | None) -> bool:
    """Return whether the second operand of a layer is computed, as an attention's.

    Products of two activations take 1.1 to 1.8 of float's time in int8.
    """
    pair = dequantizer_of(value)
    quantize = None if pair is None else maker(pair.inputs[0], QUANTIZE)
    return quantize is not None and array_of(quantize.inputs[0]) is None


def _ends(value: ir.Value, *, takes_relu: bool) -> list[ir.Node]:
    """List the readers of a layer's output, past what onnxruntime takes in.

    A ReLU goes where the grid behind it begins at zero; elsewhere it hides the layer,
    and a Gemm that was made of a MatMul takes none.
    """
    readers = [] if value.is_graph_output() else list(value.consumers())
    if len(readers) != 1:
        return readers
    behind = readers[0].outputs[0]
    if is_clip_at_zero(readers[0]):
        ends = _ends(behind, takes_relu=takes_relu)
        goes = takes_relu and all(map(_begins_at_zero, ends))
        return ends if goes else [*readers, *ends]
    passed = readers[0].op_type in _PASSED
    return _ends(behind, takes_relu=takes_relu) if passed else readers


def _begins_at_zero(node: ir.Node) -> bool:
    """Return whether a node quantizes to a grid whose least number stands for zero."""
    least = _LEAST.get(_kind_of(node)) if node.op_type == QUANTIZE else None
    return least is not None and bool((_zeros_of(node) == least).all())


def _zeros_of(pair: ir.Node) -> npt.NDArray[np.generic]:
    """Return the zero points of a QuantizeLinear or DequantizeLinear; 0 without."""
    zeros = array_of(input_at(pair, 2))
    return np.zeros(1, np.int8) if zeros is None else zeros


def _kind_of(pair: ir.Node) -> ir.DataType:
    """Return what a QuantizeLinear writes, or a DequantizeLinear reads.

    That is its zero point's type or, without one, what ``output_dtype`` says: uint8 by
    default.
    """
    zeros = array_of(input_at(pair, 2))
    if zeros is not None:
        return ir.DataType.from_numpy(zeros.dtype)
    source = pair if pair.op_type == QUANTIZE else maker(pair.inputs[0], QUANTIZE)
    number = 0 if source is None else source.attributes.get_int("output_dtype", 0)
    return ir.DataType(number or ir.DataType.UINT8)
