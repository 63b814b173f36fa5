"""Deformable attention from offsets and scores, whose operands repeat.

Locations and weights that are written out are larger than all that they are made of:
in BEVFormer's camera attention (arXiv 2203.17270, equation 4) six cameras share a
query's offsets and scores, and heads share its reference points.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.operators.call import Attributes, FusedCall, Size
from me2e_compress.operators.dialect import (
    FLOATS,
    INTEGERS,
    OWN_DOMAIN,
    Dialect,
    Operand,
    Shapes,
    Values,
    present,
)
from me2e_compress.operators.kernels.kernel import DOMAIN

RAW_ATTENTION = "RawDeformableAttention"


@dataclasses.dataclass(frozen=True)
class RawOwnForm(Dialect):
    """The toolkit's own form before positions are added and weights normalized.

    ``me2e::RawDeformableAttention``: value, spatial_shapes and level_start_index as in
    ``me2e::MultiScaleDeformableAttention``; then, all float,

    * reference_points [n, q, m, l, p, 2] and sampling_offsets [N, Q, M, l, P, 2]: their
      sum is the location, in 0..1 of each level;
    * attention_scores [n, q, m, r, c]: the softmax over c, whose r * c weights are
      those of the L * P points of a head in sequence;
    * mask [n, q, m, l, p], a factor of the weights. Points where it is 0 are not read.

    n, q and m are N, Q and M, or 1; l and p divide L and P, and r * c divides L * P.
    Smaller operands repeat. Levels are those of one camera after the other: offsets and
    scores are of a level of every camera, k % l of level k; reference points and mask
    are of all levels of a camera, k * l // L.
    """

    def inputs_to_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Write the locations and the weights."""
        value, shapes, starts, reference, offsets, scores, mask = present(inputs)
        sizes = [call.size(offsets, axis) for axis in range(3)]
        levels, points = call.size(shapes, 0), call.size(offsets, 4)
        full = {3: levels, 4: points}
        # The sum of reference points and offsets
        near, factor = (
            _tiled(call, _by_camera(call, each, levels), {4: points}, beside=True)
            for each in (reference, mask)
        )
        locations = call.add("Add", [near, _tiled(call, offsets, full)])
        # The softmax, then the mask
        soft = call.add("Softmax", [scores], {"axis": -1})
        heads = [call.size(scores, axis) for axis in range(3)]
        row = call.product(call.size(scores, 3), call.size(scores, 4))
        soft = call.reshape(soft, (*heads, row))
        soft = _tiled(call, soft, {3: call.product(levels, points)})
        soft = call.reshape(soft, (*heads, levels, points))
        weights = call.add("Mul", [soft, factor])
        whole = [*sizes, levels, points]
        if [call.size(weights, axis) for axis in range(5)] != whole:
            weights = call.add("Expand", [weights, call.sizes(whole)])
        return (value, shapes, starts, locations, weights)

    def inputs_from_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Write reference points at 0 and equal scores; the mask is the weights."""
        value, shapes, starts, locations, weights = present(inputs)
        reference = call.numbers(np.zeros((1, 1, 1, 1, 1, 2)), locations)
        scores = call.numbers(np.zeros((1, 1, 1, 1, 1)), weights)
        return (value, shapes, starts, reference, locations, scores, weights)

    def by_kernel(self, call: FusedCall, inputs: Values) -> ir.Value | None:
        """Call the kernel with the operands as they are, if they are float32."""
        floats = [each for each in present(inputs) if each.dtype not in INTEGERS]
        if any(each.dtype not in (None, ir.DataType.FLOAT) for each in floats):
            return None
        result = call.add(RAW_ATTENTION, inputs, domain=DOMAIN)
        value, offsets = present(inputs)[0], present(inputs)[4]
        sizes = [call.known_size(offsets, axis) for axis in range(3)]
        result.shape = ir.Shape([*sizes, call.known_size(value, 3)])
        result.type = ir.TensorType(ir.DataType.FLOAT)
        return result

    def shapes_to_own(self, shapes: Shapes) -> Shapes:
        """Say how many levels and points there are after repetition."""
        value, sizes, starts, _, offsets, *_ = shapes
        if offsets is None:
            return (value, sizes, starts, None, None)
        levels = None if sizes is None else sizes[0]
        own = (*offsets[:3], levels, offsets[4])
        return (value, sizes, starts, (*own, 2), own)


def raw_own_form() -> RawOwnForm:
    """Return the dialect ``me2e-raw``."""
    operands = (
        Operand("value", "N S M D"),
        Operand("spatial_shapes", "L 2", INTEGERS),
        Operand("level_start_index", "L", INTEGERS),
        Operand("reference_points", "* * * * * 2", FLOATS, positions=True),
        Operand("sampling_offsets", "N Q M * P 2", FLOATS, positions=True),
        Operand("attention_scores", "* * * * *", FLOATS, scores=True),
        Operand("mask", "* * * * *"),
    )
    return RawOwnForm("me2e-raw", RAW_ATTENTION, OWN_DOMAIN, operands, "me2e")


def _tiled(
    call: FusedCall, value: ir.Value, full: Mapping[int, Size], *, beside: bool = False
) -> ir.Value:
    """Repeat a value along axes up to full sizes; ``beside`` a value that has them.

    There sizes of 1 are left to broadcasting.
    """
    times: dict[int, Size] = {}
    for axis, wanted in full.items():
        size = call.size(value, axis)
        if size == wanted or (beside and size == 1):
            continue
        if not isinstance(size, int) or not isinstance(wanted, int):
            parts = [call.value_of(count) for count in (wanted, size)]
            times[axis] = call.add("Div", parts)
        elif size == 0 or wanted % size:
            raise PreconditionError(
                f"node {call.node.name}: {value.name} has {size} of axis {axis}, which"
                f" do not divide {wanted}"
            )
        else:
            times[axis] = wanted // size
    if not times:
        return value
    rank = len(value.shape) if value.shape is not None else max(full) + 1
    counts = call.sizes([times.get(axis, 1) for axis in range(rank)])
    return call.add("Tile", [value, counts])


def _by_camera(call: FusedCall, value: ir.Value, levels: Size) -> ir.Value:
    """Take for each level what its camera has; sizes of 1 are left to broadcasting."""
    size = call.size(value, 3)
    if size in (1, levels):
        return value
    count, total = call.value_of(size), call.value_of(levels)
    product = call.add("Mul", [call.counting(levels), count])
    index = call.add("Div", [product, total])
    return call.add("Gather", [value, index], {"axis": 3})
