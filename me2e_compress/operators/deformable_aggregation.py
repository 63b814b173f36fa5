"""Deformable feature aggregation (Sparse4D, arXiv 2211.10581; SparseDrive)."""

import dataclasses
import functools

import numpy as np
import onnx_ir as ir

from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    FLOAT32,
    FLOATS,
    INT8_TOO,
    INT32,
    INTEGERS,
    OWN_DOMAIN,
    Arrays,
    Dialect,
    NdArray,
    Operand,
    Shapes,
    Values,
    present,
)
from me2e_compress.operators.grid_sampler import sample_levels, sample_levels_array


def _operands(
    integers: tuple[ir.DataType, ...], feature: tuple[ir.DataType, ...]
) -> tuple[Operand, ...]:
    return (
        Operand("mc_ms_feat", "N S C", feature),
        Operand("spatial_shape", "V L 2", integers),
        Operand("scale_start_index", "V L", integers),
        Operand("sampling_location", "N A P V 2", positions=True),
        Operand("weights", "N A P V L G"),
    )


@dataclasses.dataclass(frozen=True)
class ScaledFeature(Dialect):
    """SparseDriveV2, whose int8 features have a scale per channel as a sixth input."""

    def inputs_to_own(
        self, call: FusedCall, inputs: Values, attributes: Attributes
    ) -> Values:
        """Multiply the features by their scales."""
        if len(inputs) < 6 or inputs[5] is None:
            return inputs[:5]
        feature, *others, scale = present(inputs)
        wide = call.cast(feature, scale.dtype or ir.DataType.FLOAT)
        return (call.add("Mul", [wide, scale]), *others)

    def shapes_to_own(self, shapes: Shapes) -> Shapes:
        """Drop the shape of the scales."""
        return shapes[:5]

    def output_type(self, inputs: Values) -> ir.DataType | None:
        """Return the type of the scales, if there are any."""
        scaled = len(inputs) > 5 and inputs[5] is not None
        return super().output_type(inputs[5:] if scaled else inputs)


_OP, _PLUGIN_OP = "DeformableAggregation", "DeformableAttentionAggrPlugin"
_PLUGIN = _operands(INT32, FLOATS)


@dataclasses.dataclass(frozen=True)
class DeformableAggregation(Operator):
    """A weighted sum of samples of all cameras and levels, for each anchor.

    Own form ``me2e::DeformableAggregation``: mc_ms_feat [N, S, C], the maps of all
    cameras concatenated; spatial_shape [V, L, 2] (H, W) of V cameras; scale_start_index
    [V, L]; sampling_location [N, A, P, V, 2] (x, y), of which only those strictly
    between 0 and 1 count; weights [N, A, P, V, L, G]. Channel c reads group c // (C /
    G). Output [N, A, C], the sum over points, cameras and levels.
    """

    name = "deformable-aggregation"
    output = "N A C"
    work = "4 N A P V L C"
    int8_inputs = (0,)
    own = Dialect("me2e", _OP, OWN_DOMAIN, _operands(INTEGERS, FLOATS), "me2e")
    dialects = (
        Dialect("sparsedrive", _OP, "SparseDrive", _PLUGIN, "SparseDrive"),
        ScaledFeature(
            "sparsedrive-v2",
            _OP,
            "sparsedrivev2",
            (
                *_operands(INT32, INT8_TOO),
                Operand("feat_scale", "C", FLOAT32, optional=True),
            ),
            "SparseDriveV2",
            int8_scale=5,
        ),
        Dialect("sparseend2end", _PLUGIN_OP, "custom", _PLUGIN, "SparseEnd2End"),
    )

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write it as deformable attention whose heads are the channel groups."""
        feature, sizes, starts, at, weights = present(inputs)
        batch, anchors, points, cameras, levels, groups = (
            call.size(weights, axis) for axis in range(6)
        )
        width = call.size(feature, 2)
        parts = -1
        if isinstance(width, int) and isinstance(groups, int):
            parts = width // groups
        # Channel groups are heads; cameras times levels are maps
        value = call.reshape(feature, (batch, call.size(feature, 1), groups, parts))
        maps = call.product(cameras, levels)
        places = call.transpose(at, (0, 1, 3, 2, 4))  # [N, A, V, P, 2]
        places = call.unsqueeze(places, (2, 4))  # [N, A, 1, V, 1, P, 2]
        shape = call.sizes((batch, anchors, 1, cameras, levels, points, 2))
        places = call.add("Expand", [places, shape])
        places = call.reshape(places, (batch, anchors, 1, maps, points, 2))
        # Positions outside of an image have no weight
        sides = []
        for axis in call.split_last(at, 2):
            above = call.add("Greater", [axis, call.numbers(0.0, axis)])
            sides += [above, call.add("Less", [axis, call.numbers(1.0, axis)])]
        both = functools.reduce(lambda one, two: call.add("And", [one, two]), sides)
        inside = call.unsqueeze(both, (4, 5))  # [N, A, P, V, 1, 1]
        weights = call.add("Where", [inside, weights, call.numbers(0.0, weights)])
        weights = call.transpose(weights, (0, 1, 5, 3, 4, 2))  # [N, A, G, V, L, P]
        weights = call.reshape(weights, (batch, anchors, groups, maps, points))
        result = sample_levels(
            call,
            value,
            call.reshape_table(sizes, (-1, 2)),
            call.reshape_table(starts, (-1,)),
            places,
            weights,
        )
        return call.reshape(result, (batch, anchors, width))

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [N, A, C] float64."""
        feature, sizes, starts, at, weights = (np.asarray(array) for array in inputs)
        batch, anchors, points, cameras, levels, groups = weights.shape
        rows, width = feature.shape[1:]
        value = feature.astype(np.float64)
        value = value.reshape(batch, rows, groups, width // groups)
        inside = np.expand_dims(((at > 0) & (at < 1)).all(axis=-1), (-2, -1))
        shares = np.where(inside, weights, 0).astype(np.float64)
        places = at.astype(np.float64).transpose(0, 1, 3, 2, 4)[:, :, None, :, None]
        shape = (batch, anchors, groups, cameras, levels, points, 2)
        result = sample_levels_array(
            value,
            sizes.reshape(-1, 2).astype(np.int64),
            starts.reshape(-1).astype(np.int64),
            np.broadcast_to(places, shape).reshape(*shape[:3], -1, points, 2),
            shares.transpose(0, 1, 5, 3, 4, 2).reshape(*shape[:3], -1, points),
        )
        return result.reshape(batch, anchors, -1)
