"""Rotation of a feature map about a point, as BEVFormer rotates its last BEV."""

import dataclasses
import math

import numpy as np
import onnx_ir as ir

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
    Shapes,
    Values,
    present,
)
from me2e_compress.operators.grid_sampler import (
    BILINEAR,
    grid_sample_array,
    sample_levels,
)

_INTERPOLATION = (Attribute("interpolation", 0, choices=(0, 1)),)


def _dialect(name: str, op_type: str, domain: str, source: str) -> Dialect:
    types = INT8_TOO if source == _DERRYHUB else FLOATS
    operands = (
        Operand("img", "C H W", types),
        Operand("angle", "1", types, positions=True),
        Operand("center", "2", types, positions=True),
    )
    return Dialect(name, op_type, domain, operands, source, _INTERPOLATION)


_DERRYHUB = "BEVFormer_tensorrt"


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
    own = _dialect("me2e", "Rotate", OWN_DOMAIN, "me2e")
    dialects = (
        _dialect("derryhub", "RotateTRT", "", _DERRYHUB),
        _dialect("derryhub-trt2", "RotateTRT2", "", _DERRYHUB),
        _dialect("dl4agx-uniad", "RotateTRT", "", _DERRYHUB),
        _dialect("dl4agx", "RotatePlugin", "custom_op", "DL4AGX"),
        _dialect("autoware", "RotatePlugin", "", "Autoware"),
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
