"""The flagged rows of a table, padded to a fixed number."""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    FLOAT32,
    FLOATS,
    INT32,
    INTEGERS,
    OWN_DOMAIN,
    Arrays,
    Attribute,
    Dialect,
    NdArray,
    Operand,
    Values,
    number,
    present,
)


def _dialect(
    name: str,
    op_type: str,
    domain: str,
    source: str,
    types: tuple[ir.DataType, ...] = FLOATS,
    flags: tuple[ir.DataType, ...] = INT32,
) -> Dialect:
    operands = (
        Operand("feat", "B Q C", types),
        Operand("flag", "B Q", flags),
        Operand("invalid", "C", types),
    )
    return Dialect(name, op_type, domain, operands, source, (Attribute("P", 16),))


@dataclasses.dataclass(frozen=True)
class SelectAndPad(Operator):
    """The first flagged rows, in order, padded with a given row.

    Own form ``me2e::SelectAndPad``: feat [B, Q, C]; flag int32 or int64 [B, Q], above 0
    where a row is selected; invalid [C]; ``P`` rows. Output [B, P, C].
    """

    name = "select-and-pad"
    output = "B P C"
    work = "0"
    own = _dialect("me2e", "SelectAndPad", OWN_DOMAIN, "me2e", FLOATS, INTEGERS)
    dialects = (
        _dialect("dl4agx", "SelectAndPadPlugin", "custom_op", "DL4AGX", FLOAT32),
        _dialect("autoware", "SelectAndPadPlugin", "", "Autoware"),
    )

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Take the first P flagged rows (TopK of negative indices), then pad."""
        feature, flag, invalid = present(inputs)
        count, rows = number(attributes, "P"), call.size(feature, 1)
        if not isinstance(rows, int) or rows < count:  # there must be P rows to take
            more = call.integers([0, 0, 0, 0, count, 0])
            feature = call.add("Pad", [feature, more])
            flag = call.cast(flag, ir.DataType.INT32)
            flag = call.add("Pad", [flag, call.integers([0, 0, 0, count])])
            rows = call.size(feature, 1)
        # Rank flagged rows by index, all others last
        numbers = call.cast(call.counting(rows), ir.DataType.FLOAT)
        first = call.add("Sub", [call.numbers(0.0, numbers), numbers])
        last = call.numbers(float("-inf"), numbers)
        wide = call.cast(flag, ir.DataType.INT64)
        flagged = call.add("Greater", [wide, call.integers(0)])
        order = call.add("Where", [flagged, first, last])  # -index or -infinity, [B, Q]
        best = call.add("TopK", [order, call.integers([count])], outputs=2)
        index = best.producer().outputs[1]  # type: ignore[union-attr]
        index = call.unsqueeze(index, (2,))
        # Replace unflagged rows by the padding
        gathered = call.add("GatherND", [feature, index], {"batch_dims": 1})
        none = call.add("Equal", [best, last])
        return call.add("Where", [call.unsqueeze(none, (2,)), invalid, gathered])

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [B, P, C] float64."""
        feature, flag, invalid = (np.asarray(value) for value in inputs)
        count = number(attributes, "P")
        result = np.empty((len(feature), count, feature.shape[2]))
        result[:] = invalid
        for index, rows in enumerate(feature):
            chosen = rows[flag[index] > 0][:count]
            result[index, : len(chosen)] = chosen
        return result
