"""Whether any of many conditions is true, without counting them in integers.

Given:   Greater(ReduceSum(Cast(conditions) to int64), 0)

Result:  Greater(ReduceSum(Cast(conditions) to float), 0)

torch writes ``count_nonzero(x) > 0`` so. A sum of ones is above 0 in either type, and
onnxruntime's CPU (1.31) adds 2.56 million float32 in 0.2 ms, int64 in 5.
"""

import numpy as np
import onnx_ir as ir

from me2e_compress.graph.rewrite import Facts, Fusion, Kit, Match, constant, op, var

CONDITIONS = var("conditions")
ZERO = constant(floating=False, scalar=True)
SUM = op("ReduceSum", op("Cast", CONDITIONS), more=True)
PATTERN = op("Greater", SUM, ZERO)


def _counts(match: Match, facts: Facts) -> bool:
    zero = match.array(ZERO)
    integers = zero.dtype.kind in "iu" and not zero.any()
    return integers and match[CONDITIONS].dtype == ir.DataType.BOOL


def _add_in_float(match: Match, kit: Kit) -> None:
    total, zero = match.node(SUM), match.array(ZERO)
    real = kit.add("Cast", [match[CONDITIONS]], {"to": int(ir.DataType.FLOAT)})
    options = {name: attr.value for name, attr in total.attributes.items()}
    added = kit.add("ReduceSum", [real, *total.inputs[1:]], options)
    name = f"{match[ZERO].name}_float"
    kit.put("Greater", [added, kit.constant(zero.astype(np.float32), name)])


FUSION = Fusion("sums of conditions", PATTERN, _add_in_float, where=_counts)
