"""Bird's-eye views: pooled from cameras (BEVPoolv2, arXiv 2211.17111), and rotated.

BEVFormer rotates its last view about the car before it attends to it.
"""

import dataclasses
import math

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
from me2e_compress.operators.grid_sampler import (
    BILINEAR,
    grid_sample_array,
    sample_levels,
)

_SIZES = (Attribute("out_height", 128), Attribute("out_width", 128))


def _pooling(name: str, op_type: str, domain: str, source: str) -> Dialect:
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
    own = _pooling("me2e", "BEVPoolV2", OWN_DOMAIN, "me2e")
    dialects = (
        _pooling("derryhub", "BEVPoolV2TRT", "", _DERRYHUB),
        _pooling("derryhub-trt2", "BEVPoolV2TRT2", "", _DERRYHUB),
        _pooling("mmdeploy", "bev_pool_v2", "mmdeploy", "BEVDet"),
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


_INTERPOLATION = (Attribute("interpolation", 0, choices=(0, 1)),)


def _rotation(name: str, op_type: str, domain: str, source: str) -> Dialect:
    types = INT8_TOO if source == _DERRYHUB else FLOATS
    operands = (
        Operand("img", "C H W", types),
        Operand("angle", "1", types, positions=True),
        Operand("center", "2", types, positions=True),
    )
    return Dialect(name, op_type, domain, operands, source, _INTERPOLATION)


@dataclasses.dataclass(frozen=True)
class Rotate(Operator):
    """Rotate a feature map by an angle about a point, with zeros from outside.

    Own form ``me2e::Rotate``: img [C, H, W]; angle [1] in degrees; center [2] (x, y) in
    pixels; ``interpolation`` 0 bilinear, 1 nearest (halves to the even pixel). Output
    [C, H, W], as torchvision's ``rotate`` (BEVFormer_tensorrt, rotateKernel.cu).
    """

    name = "rotate"
    output = "C H W"
    work = "4 C H W"
    own = _rotation("me2e", "Rotate", OWN_DOMAIN, "me2e")
    dialects = (
        _rotation("derryhub", "RotateTRT", "", _DERRYHUB),
        _rotation("derryhub-trt2", "RotateTRT2", "", _DERRYHUB),
        _rotation("dl4agx-uniad", "RotateTRT", "", _DERRYHUB),
        _rotation("dl4agx", "RotatePlugin", "custom_op", "DL4AGX"),
        _rotation("autoware", "RotatePlugin", "", "Autoware"),
    )

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Sample the map at the rotated positions of its pixels."""
        image, angle, center = present(inputs)
        channels, height, width = (call.size(image, axis) for axis in range(3))
        rows = call.transpose(call.reshape(image, (channels, -1)), (1, 0))
        value = call.unsqueeze(rows, (0, 2))  # [1, H*W, 1, C]
        # Positions as 0..1 of the map
        x, y = self._positions(call, image, angle, center)
        places = []
        for at, size in ((x, width), (y, height)):
            if attributes["interpolation"] == 1:
                at = call.add("Round", [at])
            middle = call.add("Add", [at, call.numbers(0.5, at)])
            count = call.cast(call.value_of(size), at.dtype or ir.DataType.FLOAT)
            scaled = call.add("Div", [middle, count])
            places.append(call.reshape(scaled, (1, -1, 1, 1, 1, 1)))
        at = call.concat(places, 5)
        # Sample as one level with one head
        pixels = call.product(height, width)
        weights = call.full((1, pixels, 1, 1, 1), 1.0, at)
        sizes = call.sizes((height, width), (1, 2))
        result = sample_levels(call, value, sizes, call.integers([0]), at, weights)
        result = call.transpose(call.reshape(result, (pixels, channels)), (1, 0))
        return call.reshape(result, (channels, height, width))

    def _positions(
        self, call: FusedCall, image: ir.Value, angle: ir.Value, center: ir.Value
    ) -> tuple[ir.Value, ir.Value]:
        turn = call.add("Mul", [angle, call.numbers(math.pi / 180, angle)])
        cosine, sine = call.add("Cos", [turn]), call.add("Sin", [turn])
        kind = angle.dtype or ir.DataType.FLOAT
        # Pixel centres relative to the centre of rotation
        middles = []
        for axis, at in zip((2, 1), call.split_last(center, 2), strict=True):
            counted = call.cast(call.counting(call.size(image, axis)), kind)
            half = call.add("Add", [counted, call.numbers(0.5, counted)])
            middles.append((call.add("Sub", [half, at]), at))
        (across, x), (down, y) = middles
        down = call.unsqueeze(down, (1,))
        # Rotate: x cos - y sin, x sin + y cos
        ends = []
        for op_type, one, two in (("Sub", cosine, sine), ("Add", sine, cosine)):
            terms = [call.add("Mul", [one, across]), call.add("Mul", [two, down])]
            ends.append(call.add(op_type, terms))
        # Move back, to pixel positions
        half = call.numbers(0.5, angle)
        return (
            call.add("Add", [ends[0], call.add("Sub", [x, half])]),
            call.add("Add", [ends[1], call.add("Sub", [y, half])]),
        )

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [C, H, W] float64."""
        image, angle, center = (np.asarray(value, np.float64) for value in inputs)
        height, width = image.shape[1:]
        # Rotate the pixel centres back
        turn = -np.deg2rad(angle.item())
        y, x = np.mgrid[:height, :width] + 0.5
        x, y = x - center[0], y - center[1]
        across = np.cos(turn) * x + np.sin(turn) * y + center[0]
        down = -np.sin(turn) * x + np.cos(turn) * y + center[1]
        at = np.stack([across, down], axis=-1)
        # Sample, rounded to pixel centres for nearest
        if attributes["interpolation"] == 1:
            at = np.round(at - 0.5) + 0.5
        size = np.array([width, height], np.float64)
        grid = 2 * at[None] / size - 1
        return grid_sample_array((image[None], grid), BILINEAR).squeeze(0)

    def macs(self, shapes: Shapes, attributes: Attributes) -> int | None:
        """Count four neighbours for each element; none for the nearest."""
        nearest = attributes["interpolation"] == 1
        return 0 if nearest else super().macs(shapes, attributes)
