"""Attention of one or several heads (Attention is all you need, equation 1)."""

import dataclasses
import math

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    FLOATS,
    INT8_TOO,
    OWN_DOMAIN,
    Arrays,
    Attribute,
    Dialect,
    NdArray,
    Operand,
    Values,
    present,
)
from me2e_compress.operators.kernels.kernel import ATTENTION, DOMAIN, WIDEST_HEAD


def _operands(types: tuple[ir.DataType, ...]) -> tuple[Operand, ...]:
    return (
        Operand("query", "B Q C", types),
        Operand("key", "B K C", types),
        Operand("value", "B K C", types),
    )


@dataclasses.dataclass(frozen=True)
class HeadsInBatch(Dialect):
    """A library that has no number of heads: they are in the batch."""

    def inputs_from_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Refuse several heads side by side."""
        if _heads(attributes) != 1:
            raise PreconditionError(
                f"node {call.node.name}: {self.op_type} of {self.source} takes heads in"
                f" the batch, and these are {_heads(attributes)} side by side"
            )
        return super().inputs_from_own(call, inputs, attributes)


def _heads(attributes: Attributes) -> int:
    heads = attributes.get("heads", 1)
    assert isinstance(heads, int)
    return heads


@dataclasses.dataclass(frozen=True)
class FusedMultiHeadAttention(Operator):
    """Softmax(query key^T / sqrt(C)) value, for each head of C channels.

    Own form ``me2e::MultiHeadAttention``: query [B, Q, C]; key and value [B, K, C];
    output [B, Q, C]. With the attribute ``heads``, 1 if left out, these are so many
    heads side by side, of C / heads channels each.
    """

    name = "multi-head-attention"
    output = "B Q C"
    work = "2 B Q C K"
    own = Dialect(
        "me2e", "MultiHeadAttention", OWN_DOMAIN, _operands(FLOATS), "me2e",
        (Attribute("heads", 1, required=False),),
    )  # fmt: skip
    dialects = tuple(
        HeadsInBatch(name, op_type, "", _operands(INT8_TOO), "BEVFormer_tensorrt")
        for name, op_type in (("derryhub", "QKVTRT"), ("derryhub-trt2", "QKVTRT2"))
    )

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Call the kernel, or write both products and the softmax."""
        query, key, value = present(inputs)
        heads = _heads(attributes)
        width = call.known_size(query, -1)
        fits = width is not None and 0 < width <= WIDEST_HEAD * heads
        if call.compiled and fits and query.dtype in (None, ir.DataType.FLOAT):
            rows = [_split(call, part, heads) for part in (query, key, value)]
            result = call.add(ATTENTION, rows, domain=DOMAIN)
            result.type, result.shape = rows[0].type, rows[0].shape
            return _joined(call, result, query)
        if heads == 1:
            return _written(call, query, call.transpose(key, (0, 2, 1)), value)
        # Put the heads into the batch, and take them out again
        swap = (0, 2, 1, 3)
        query_rows = call.transpose(_split(call, query, heads), swap)
        turned_key = call.transpose(_split(call, key, heads), (0, 2, 3, 1))
        value_rows = call.transpose(_split(call, value, heads), swap)
        result = _written(call, query_rows, turned_key, value_rows)
        return _joined(call, call.transpose(result, swap), query)

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [B, Q, C] float64."""
        heads = _heads(attributes)
        arrays = (np.asarray(array, np.float64) for array in inputs)
        query, key, value = (  # [B, heads, rows, C / heads]
            rows.reshape(*rows.shape[:2], heads, -1).transpose(0, 2, 1, 3)
            for rows in arrays
        )
        scores = query @ key.transpose(0, 1, 3, 2) / math.sqrt(query.shape[-1])
        weights = np.exp(scores - scores.max(axis=-1, keepdims=True))
        result = (weights / weights.sum(axis=-1, keepdims=True)) @ value
        joined: NdArray = result.transpose(0, 2, 1, 3)
        return joined.reshape(*joined.shape[:2], -1)


def _split(call: FusedCall, rows: ir.Value, heads: int) -> ir.Value:
    """Split heads: [B, Q, C] to [B, Q, heads, C / heads]."""
    return call.reshape(rows, (call.size(rows, 0), call.size(rows, 1), heads, -1))


def _joined(call: FusedCall, result: ir.Value, query: ir.Value) -> ir.Value:
    return call.reshape(result, (call.size(query, 0), call.size(query, 1), -1))


def _written(
    call: FusedCall, query: ir.Value, turned_key: ir.Value, value: ir.Value
) -> ir.Value:
    """Write attention whose heads are in the batch, in standard operators."""
    width = call.size(query, -1)
    count = call.cast(call.value_of(width), query.dtype or ir.DataType.FLOAT)
    query = call.add("Div", [query, call.add("Sqrt", [count])])
    scores = call.add("MatMul", [query, turned_key])  # [..., Q, K]
    weights = call.add("Softmax", [scores], {"axis": -1})
    return call.add("MatMul", [weights, value])
