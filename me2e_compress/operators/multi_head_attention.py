"""Attention whose heads are in the batch (Attention is all you need, equation 1)."""

import dataclasses
import math
from typing import ClassVar

import numpy as np
import onnx_ir as ir

from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    FLOATS,
    INT8_TOO,
    OWN_DOMAIN,
    Arrays,
    Dialect,
    NdArray,
    Operand,
    Values,
    present,
)


def _dialect(name: str, op_type: str, domain: str, source: str) -> Dialect:
    types = FLOATS if domain == OWN_DOMAIN else INT8_TOO
    operands = (
        Operand("query", "B Q C", types),
        Operand("key", "B K C", types),
        Operand("value", "B K C", types),
    )
    return Dialect(name, op_type, domain, operands, source)


@dataclasses.dataclass(frozen=True)
class FusedMultiHeadAttention(Operator):
    """Softmax(query key^T / sqrt(C)) value, for each head.

    Own form ``me2e::MultiHeadAttention``: query [B, Q, C]; key and value [B, K, C];
    heads are in B. Output [B, Q, C].
    """

    name: ClassVar[str] = "multi-head-attention"
    output: ClassVar[str] = "B Q C"
    work: ClassVar[str] = "2 B Q C K"
    own: ClassVar[Dialect] = _dialect("me2e", "MultiHeadAttention", OWN_DOMAIN, "me2e")
    dialects: ClassVar[tuple[Dialect, ...]] = (
        _dialect("derryhub", "QKVTRT", "", "BEVFormer_tensorrt"),
        _dialect("derryhub-trt2", "QKVTRT2", "", "BEVFormer_tensorrt"),
    )

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write both products and the softmax."""
        query, key, value = present(inputs)
        width = call.size(query, -1)
        count = call.cast(call.value_of(width), query.dtype or ir.DataType.FLOAT)
        query = call.add("Div", [query, call.add("Sqrt", [count])])
        scores = call.add("MatMul", [query, call.transpose(key, (0, 2, 1))])
        weights = call.add("Softmax", [scores], {"axis": -1})
        return call.add("MatMul", [weights, value])

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [B, Q, C] float64."""
        query, key, value = (np.asarray(each, np.float64) for each in inputs)
        scores = query @ key.transpose(0, 2, 1) / math.sqrt(query.shape[-1])
        weights = np.exp(scores - scores.max(axis=-1, keepdims=True))
        result: NdArray = (weights / weights.sum(axis=-1, keepdims=True)) @ value
        return result
