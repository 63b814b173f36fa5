"""BEV pooling of camera features by depth (BEVPoolv2, arXiv 2211.17111)."""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.graph.shapes import Dims, product
from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    FLOATS,
    INT8_TOO,
    INT32,
    INTEGERS,
    OWN_DOMAIN,
    Arrays,
    Attribute,
    Dialect,
    NdArray,
    Operand,
    Shapes,
    Values,
    number,
    present,
)

_SIZES = (Attribute("out_height", 128), Attribute("out_width", 128))


def _dialect(name: str, op_type: str, domain: str, source: str) -> Dialect:
    types = INT8_TOO if source == _DERRYHUB else FLOATS
    whole = INTEGERS if domain == OWN_DOMAIN else INT32
    operands = (
        Operand("depth", None, types),
        Operand("feat", None, types),
        Operand("ranks_depth", "K", whole),
        Operand("ranks_feat", "K", whole),
        Operand("ranks_bev", "K", whole),
        Operand("interval_starts", "I", whole),
        Operand("interval_lengths", "I", whole),
    )
    return Dialect(name, op_type, domain, operands, source, _SIZES)


_DERRYHUB = "BEVFormer_tensorrt"


@dataclasses.dataclass(frozen=True)
class BEVPool(Operator):
    """The sum, for each ground cell, of camera features times their depth.

    Own form ``me2e::BEVPoolV2``: depth, of any shape; feat [..., C]; ranks_depth and
    ranks_feat [K] pair elements of depth with rows of feat, ranks_bev [K] names the
    cell of each pair; interval_starts and interval_lengths [I] are the runs of pairs
    that share a cell, each cell once. Output [1, out_height, out_width, C].
    """

    name = "bev-pool"
    own = _dialect("me2e", "BEVPoolV2", OWN_DOMAIN, "me2e")
    dialects = (
        _dialect("derryhub", "BEVPoolV2TRT", "", _DERRYHUB),
        _dialect("derryhub-trt2", "BEVPoolV2TRT2", "", _DERRYHUB),
        _dialect("mmdeploy", "bev_pool_v2", "mmdeploy", "BEVDet"),
    )

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write differences of a running sum, in float64: intervals lie anywhere."""
        depth, feature, of_depth, of_feature, of_cell, starts, lengths = present(inputs)
        kind = feature.dtype or ir.DataType.FLOAT
        channels = call.size(feature, -1)
        # Multiply paired features and depths
        rows = call.reshape(feature, (-1, channels))
        numbers = call.reshape(depth, (-1, 1))
        rows = call.add("Gather", [rows, of_feature], {"axis": 0})
        numbers = call.add("Gather", [numbers, of_depth], {"axis": 0})
        # float16 products overflow nowhere that their sum does not
        factors = [call.cast(part, ir.DataType.DOUBLE) for part in (rows, numbers)]
        weighted = call.add("Mul", factors)  # [K, C]
        # Sum each interval as a difference of running sums, [K + 1, C]
        running = call.add("CumSum", [weighted, call.integers(0)])
        running = call.add("Pad", [running, call.integers([1, 0, 0, 0])])
        ends = call.add("Add", [starts, lengths])
        upper = call.add("Gather", [running, ends], {"axis": 0})
        lower = call.add("Gather", [running, starts], {"axis": 0})
        sums = call.cast(call.add("Sub", [upper, lower]), kind)
        # Scatter the sums to their cells
        cells = call.add("Gather", [of_cell, starts], {"axis": 0})
        cells = call.unsqueeze(call.cast(cells, ir.DataType.INT64), (1,))
        height, width = (number(attributes, name.name) for name in _SIZES)
        ground = call.full((height * width, channels), 0.0, feature)
        ground = call.add("ScatterND", [ground, cells, sums])
        return call.reshape(ground, (1, height, width, channels))

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [1, out_height, out_width, C] float64."""
        depth, feature, of_depth, of_feature, of_cell, starts, lengths = (
            np.asarray(value) for value in inputs
        )
        rows = feature.reshape(-1, feature.shape[-1]).astype(np.float64)
        numbers = depth.reshape(-1).astype(np.float64)
        height, width = (number(attributes, name.name) for name in _SIZES)
        ground = np.zeros((height * width, rows.shape[1]))
        for start, length in zip(starts, lengths, strict=True):
            one = slice(start, start + length)
            ground[of_cell[start]] = numbers[of_depth[one]] @ rows[of_feature[one]]
        return ground.reshape(1, height, width, -1)

    def output_shape(self, shapes: Shapes, attributes: Attributes) -> Dims | None:
        """Return [1, out_height, out_width, C]."""
        sizes = (number(attributes, size.name) for size in _SIZES)
        feature = shapes[1]
        return (1, *sizes, None if feature is None else feature[-1])

    def macs(self, shapes: Shapes, attributes: Attributes) -> int | None:
        """Count one for each of the K points and C channels."""
        feature, ranks = shapes[1], shapes[2]
        if feature is None or ranks is None:
            return None
        return product((ranks[0], feature[-1]))
