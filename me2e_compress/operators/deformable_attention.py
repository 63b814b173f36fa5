"""Multi-scale deformable attention (Deformable DETR, arXiv 2010.04159, equation 3)."""

import dataclasses
import math
from collections.abc import Iterable, Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import array_of
from me2e_compress.graph.nodes import maker, permutation_of
from me2e_compress.graph.shapes import Dims, product, static_shape
from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall, Size
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
    present,
)
from me2e_compress.operators.grid_sampler import sample_levels, sample_levels_array
from me2e_compress.operators.kernels.kernel import DOMAIN


@dataclasses.dataclass(frozen=True)
class JoinedHeads(Dialect):
    """A library whose output is [N, Q, M * D] instead of [N, Q, M, D]."""

    def result_to_own(self, call: FusedCall, result: ir.Value, own: Values) -> ir.Value:
        """Split the heads."""
        value, _, _, locations, _ = present(own)
        sizes = (call.size(value, 0), call.size(locations, 1))
        return call.reshape(result, (*sizes, call.size(value, 2), call.size(value, 3)))

    def result_from_own(
        self, call: FusedCall, result: ir.Value, own: Values
    ) -> ir.Value:
        """Join the heads."""
        value, _, _, locations, _ = present(own)
        width = call.product(call.size(value, 2), call.size(value, 3))
        sizes = (call.size(value, 0), call.size(locations, 1), width)
        return call.reshape(result, sizes)

    def shape_from_own(self, shape: Dims) -> Dims:
        """Join the heads."""
        return (*shape[:2], product(shape[2:]))


@dataclasses.dataclass(frozen=True)
class RawAttention(Dialect):
    """A library that takes reference points, offsets in pixels and raw weights.

    With g reference points, point p refers to reference point p % g; the softmax is
    over all levels and points (BEVFormer_tensorrt, multiScaleDeformableAttnKernel.cu).
    """

    def inputs_to_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Write the locations, the softmax and the start of each level."""
        value, shapes, reference, offsets, weights = present(inputs)
        # Offsets are in pixels of each level: divide by (W, H)
        levels, group = _levels_and_group(call, shapes, reference, offsets, weights)
        batch, queries, heads = (call.size(offsets, axis) for axis in range(3))
        split = call.reshape(offsets, (batch, queries, heads, levels, -1, group, 2))
        scale = _columns_and_rows(call, shapes, offsets)  # [L, 2]
        split = call.add("Div", [split, call.unsqueeze(scale, (1, 2))])
        # Add the reference points, then normalize the weights
        points = call.reshape(reference, (batch, queries, 1, 1, 1, group, 2))
        locations = call.add("Add", [split, points])  # [N, Q, M, L, P / g, g, 2]
        locations = call.reshape(locations, (batch, queries, heads, levels, -1, 2))
        softmax = call.add("Softmax", [weights], {"axis": -1})  # [N, Q, M, L * P]
        softmax = call.reshape(softmax, (batch, queries, heads, levels, -1))
        return (value, shapes, _starts(call, shapes), locations, softmax)

    def inputs_from_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Write offsets from a reference point at 0; weights must be of a softmax."""
        value, shapes, _, locations, weights = present(inputs)
        batch, queries, heads = (call.size(locations, axis) for axis in range(3))
        # Positions 0..1 become pixels
        scale = _columns_and_rows(call, shapes, locations)
        pixels = call.add("Mul", [locations, call.unsqueeze(scale, (1,))])
        offsets = call.reshape(pixels, (batch, queries, heads, -1))
        reference = call.full((batch, queries, 1, 2), 0.0, locations)
        # The plugin applies the softmax itself
        raw = _before_softmax(call, weights)
        if raw is None:
            raise PreconditionError(
                f"node {call.node.name}: {self.op_type} of {self.source} takes weights"
                f" before their softmax, and {weights.name} is not of a softmax over"
                " all levels and points"
            )
        raw = call.reshape(raw, (batch, queries, heads, -1))
        return self.in_types(call, (value, shapes, reference, offsets, raw))

    def shapes_to_own(self, shapes: Shapes) -> Shapes:
        """Split the last axes into levels, points and x, y."""
        value, sizes, _, offsets, weights = shapes
        levels = None if sizes is None else sizes[0]
        if offsets is None or weights is None:
            return (value, sizes, (levels,), None, None)
        both = weights[3]
        points = None if both is None or not levels else both // levels
        own = (*offsets[:3], levels, points)
        return (value, sizes, (levels,), (*own, 2), own)


def _levels_and_group(
    call: FusedCall,
    shapes: ir.Value,
    reference: ir.Value,
    offsets: ir.Value,
    weights: ir.Value,
) -> tuple[int, int]:
    """Return the numbers of levels and reference points; both must be known."""
    levels = call.known_size(shapes, -2)
    pairs, steps, points = (
        call.known_size(value, -1) for value in (reference, offsets, weights)
    )
    name = f"node {call.node.name}: {call.node.op_type}"
    if levels is None or pairs is None:
        raise PreconditionError(
            f"{name}: the shapes of {shapes.name} and {reference.name} must be known"
        )
    # Offsets and weights must agree with both numbers
    group = pairs // 2
    whole = (
        steps is None
        or points is None
        or (steps == 2 * points and points % max(levels * group, 1) == 0)
    )
    if pairs % 2 or not group or not whole:
        raise PreconditionError(
            f"{name}: offsets [.., {steps}] and weights [.., {points}] do not go with"
            f" {levels} levels and reference points [.., {pairs}]"
        )
    return levels, group


def _columns_and_rows(call: FusedCall, shapes: ir.Value, like: ir.Value) -> ir.Value:
    """Write the sizes of the levels as (W, H), [L, 2], at least 1 each."""
    known = array_of(shapes)
    kind = like.dtype or ir.DataType.FLOAT
    if known is not None:
        swapped = np.maximum(known[:, ::-1], 1)
        return call.constant(swapped.astype(kind.numpy()), "sizes")
    computed = call.add("Gather", [shapes, call.integers([1, 0])], {"axis": 1})
    sizes = call.cast(computed, kind)
    return call.add("Max", [sizes, call.numbers(1.0, sizes)])


def _starts(call: FusedCall, shapes: ir.Value) -> ir.Value:
    """Write the first row of each level: the sum of the areas before it, [L]."""
    known = array_of(shapes)
    if known is not None:
        areas = known.astype(np.int64).prod(axis=1)
        return call.integers((np.cumsum(areas) - areas).tolist())
    wide = call.cast(shapes, ir.DataType.INT64)
    areas = call.add("Mul", call.split_last(wide, 2))
    return call.add("CumSum", [areas, call.integers(0)], {"exclusive": 1})


_LAYOUT = ("Expand", "Identity", "Reshape", "Squeeze", "Transpose", "Unsqueeze")


def _before_softmax(call: FusedCall, weights: ir.Value) -> ir.Value | None:
    """Write what a softmax made ``weights`` of, in their layout; None if none did."""
    # The last two axes of `weights` are one row of the softmax
    shape = static_shape(weights)
    if shape is None:
        return None
    # Walk back over layout operators that keep rows whole
    row, chain, source = math.prod(shape[-2:]), list[ir.Node](), weights
    while node := maker(source, *_LAYOUT):
        value = node.inputs[0]
        if value is None or not _keeps_rows(node, row):
            return None
        chain.append(node)
        source = value
    # The softmax must be over the last axis
    softmax = maker(source, "Softmax")
    scores = None if softmax is None else softmax.inputs[0]
    sizes = static_shape(source)
    if softmax is None or scores is None or not sizes or sizes[-1] != row:
        return None
    if softmax.attributes.get_int("axis", -1) not in (-1, len(sizes) - 1):
        return None
    # Repeat the layout operators on its input
    for node in reversed(chain):
        attributes = {name: attr.value for name, attr in node.attributes.items()}
        scores = call.add(node.op_type, [scores, *node.inputs[1:]], attributes)
    return scores


def _keeps_rows(node: ir.Node, row: int) -> bool:
    """Return whether a layout operator leaves rows of so many numbers in one piece."""
    source, result = static_shape(node.inputs[0]), static_shape(node.outputs[0])
    if source is None or result is None:
        return False
    if node.op_type not in ("Expand", "Transpose"):
        return True
    # A row consists of the last axes of the input, which must stay the last
    rank = len(source)
    sizes = (math.prod(source[rank - axes :]) for axes in range(rank + 1))
    axes = next((axes for axes, size in enumerate(sizes) if size == row), None)
    if axes is None:
        return False
    if node.op_type == "Expand":
        return source[rank - axes :] == result[len(result) - axes :]
    order = permutation_of(node) or []
    return order[rank - axes :] == list(range(rank - axes, rank))


RAW_ATTENTION = "RawDeformableAttention"


@dataclasses.dataclass(frozen=True)
class RawOwnForm(Dialect):
    """The toolkit's own form before positions are added and weights normalized.

    Locations and weights that are written out are larger than all that they are made
    of: in BEVFormer's camera attention (arXiv 2203.17270, equation 4) six cameras share
    a query's offsets and scores, and heads share its reference points.

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
            _tiled(call, _by_camera(call, operand, levels), {4: points}, beside=True)
            for operand in (reference, mask)
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
        whole = [*sizes, levels, points]  # [N, Q, M, L, P]
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
        kinds = {value.dtype for value in present(inputs)}
        if not kinds <= {None, ir.DataType.FLOAT, *INTEGERS}:
            return None
        result = call.add(RAW_ATTENTION, inputs, domain=DOMAIN)
        value, offsets = present(inputs)[0], present(inputs)[4]
        sizes = [call.known_size(offsets, axis) for axis in range(3)]
        result.shape = ir.Shape([*sizes, call.known_size(value, 3)])
        result.type = ir.TensorType(ir.DataType.FLOAT)
        return result

    def shapes_to_own(self, shapes: Shapes) -> Shapes:
        """Return shapes with all levels and points, after repetition."""
        value, sizes, starts, _, offsets, *_ = shapes
        if offsets is None:
            return (value, sizes, starts, None, None)
        levels = None if sizes is None else sizes[0]
        own = (*offsets[:3], levels, offsets[4])
        return (value, sizes, starts, (*own, 2), own)


def _tiled(
    call: FusedCall, value: ir.Value, full: Mapping[int, Size], *, beside: bool = False
) -> ir.Value:
    """Repeat a value along axes up to full sizes; ``beside`` a value that has them."""
    # There sizes of 1 are left to broadcasting
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


def _operands(integers: tuple[ir.DataType, ...]) -> tuple[Operand, ...]:
    return (
        Operand("value", "N S M D"),
        Operand("spatial_shapes", "L 2", integers),
        Operand("level_start_index", "L", integers),
        Operand("sampling_locations", "N Q M L P 2", positions=True),
        Operand("attention_weights", "N Q M L P"),
    )


def _raw_operands(integer: ir.DataType) -> tuple[Operand, ...]:
    return (
        Operand("value", "N S M D", INT8_TOO),
        Operand("spatial_shapes", "L 2", (integer,)),
        Operand("reference_points", "N Q 1 *", INT8_TOO, positions=True),
        Operand("sampling_offsets", "N Q M *", INT8_TOO, positions=True),
        Operand("attention_weights", "N Q M *", INT8_TOO, scores=True),
    )


_RAW_OWN = (
    Operand("value", "N S M D"),
    Operand("spatial_shapes", "L 2", INTEGERS),
    Operand("level_start_index", "L", INTEGERS),
    Operand("reference_points", "* * * * * 2", FLOATS, positions=True),
    Operand("sampling_offsets", "N Q M * P 2", FLOATS, positions=True),
    Operand("attention_scores", "* * * * *", FLOATS, scores=True),
    Operand("mask", "* * * * *"),
)
_PLUGIN, _RAW = _operands(INT32), _raw_operands(ir.DataType.INT32)
_RAW_INT64 = _raw_operands(ir.DataType.INT64)
_IM2COL = Attribute("im2col_step", 64, required=False, own="")
_OSS, _DL4AGX, _DERRYHUB = "TensorRT OSS", "DL4AGX", "BEVFormer_tensorrt"
_ATTENTION = "MultiscaleDeformableAttnPlugin_TRT"
_DERRYHUB_NAME = "MultiScaleDeformableAttnTRT"
_JOINED = "MultiScaleDeformableAttentionPlugin"
_MMCV = "MMCVMultiScaleDeformableAttention"


@dataclasses.dataclass(frozen=True)
class DeformableAttention(Operator):
    """A weighted sum of samples of several feature maps, for each query and head.

    Own form ``me2e::MultiScaleDeformableAttention``, inputs as in TensorRT OSS's
    plugin: value [N, S, M, D]; spatial_shapes int32 or int64 [L, 2] (H, W);
    level_start_index [L]; sampling_locations [N, Q, M, L, P, 2] (x, y) in 0..1;
    attention_weights [N, Q, M, L, P] after their softmax. Output [N, Q, M, D].
    Before that softmax it is a dialect, :class:`RawOwnForm`.
    """

    name = "deformable-attention"
    output = "N Q M D"
    work = "4 N Q M L P D"
    int8_inputs = (0,)
    own = Dialect(
        "me2e", "MultiScaleDeformableAttention", OWN_DOMAIN, _operands(INTEGERS), "me2e"
    )
    dialects = (
        Dialect("tensorrt", _ATTENTION, "trt.plugins", _PLUGIN, _OSS),
        Dialect("tensorrt-v2", _ATTENTION, "trt.plugins", _PLUGIN, _OSS, (), "2"),
        Dialect("far3d", _ATTENTION, "trt", _PLUGIN, "DL4AGX far3d"),
        JoinedHeads("dl4agx", _JOINED, "custom_op", _PLUGIN, _DL4AGX),
        JoinedHeads("autoware", _JOINED, "", _PLUGIN, "Autoware"),
        JoinedHeads("mmdeploy", _MMCV, "mmdeploy", _PLUGIN, "mmdeploy", (_IM2COL,)),
        RawAttention("derryhub", _DERRYHUB_NAME, "", _RAW, _DERRYHUB),
        RawAttention("derryhub-trt2", f"{_DERRYHUB_NAME}2", "", _RAW, _DERRYHUB),
        RawAttention(
            "dl4agx-uniad", _DERRYHUB_NAME, "", _RAW_INT64, "DL4AGX uniad-trt"
        ),
        Dialect("msda-plugin", "MSDAPlugin", "", _PLUGIN, _DL4AGX),
        RawOwnForm("me2e-raw", RAW_ATTENTION, OWN_DOMAIN, _RAW_OWN, "me2e"),
    )

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Sample every level, with GridSample where sizes are constant, else Gather."""
        return sample_levels(call, *present(inputs))

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [N, Q, M, D] float64."""
        kinds = (np.float64, np.int64, np.int64, np.float64, np.float64)
        arrays: Iterable[NdArray] = map(np.asarray, inputs, kinds)
        return sample_levels_array(*arrays)
