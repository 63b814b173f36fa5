"""Multi-scale deformable attention (Deformable DETR, arXiv 2010.04159, equation 3)."""

import dataclasses
from typing import ClassVar

import numpy as np
import onnx_ir as ir

from me2e_compress.operators.attention_layouts import JoinedHeads, RawAttention
from me2e_compress.operators.base import Operator
from me2e_compress.operators.bilinear import sample_levels, sample_levels_array
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    INT8_TOO,
    INT32,
    INTEGERS,
    OWN_DOMAIN,
    Arrays,
    Attribute,
    Dialect,
    NdArray,
    Operand,
    Values,
    present,
)
from me2e_compress.operators.raw_attention import raw_own_form


def _operands(integers: tuple[ir.DataType, ...]) -> tuple[Operand, ...]:
    return (
        Operand("value", "N S M D"),
        Operand("spatial_shapes", "L 2", integers),
        Operand("level_start_index", "L", integers),
        Operand("sampling_locations", "N Q M L P 2", positions=True),
        Operand("attention_weights", "N Q M L P"),
    )


_RAW = (
    Operand("value", "N S M D", INT8_TOO),
    Operand("spatial_shapes", "L 2", INT32),
    Operand("reference_points", "N Q 1 *", INT8_TOO, positions=True),
    Operand("sampling_offsets", "N Q M *", INT8_TOO, positions=True),
    Operand("attention_weights", "N Q M *", INT8_TOO, scores=True),
)


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
    Before that softmax it is a dialect,
    :class:`~me2e_compress.operators.raw_attention.RawOwnForm`.
    """

    name: ClassVar[str] = "deformable-attention"
    output: ClassVar[str] = "N Q M D"
    work: ClassVar[str] = "4 N Q M L P D"
    int8_inputs: ClassVar[tuple[int, ...]] = (0,)
    own: ClassVar[Dialect] = Dialect(
        "me2e", "MultiScaleDeformableAttention", OWN_DOMAIN, _operands(INTEGERS), "me2e"
    )
    dialects: ClassVar[tuple[Dialect, ...]] = (
        Dialect("tensorrt", _ATTENTION, "trt.plugins", _operands(INT32), _OSS),
        Dialect(
            "tensorrt-v2", _ATTENTION, "trt.plugins", _operands(INT32), _OSS, (), "2"
        ),
        Dialect("far3d", _ATTENTION, "trt", _operands(INT32), "DL4AGX far3d"),
        JoinedHeads("dl4agx", _JOINED, "custom_op", _operands(INT32), _DL4AGX),
        JoinedHeads("autoware", _JOINED, "", _operands(INT32), "Autoware"),
        JoinedHeads(
            "mmdeploy", _MMCV, "mmdeploy", _operands(INT32), "mmdeploy",
            (Attribute("im2col_step", 64, required=False, own=""),),
        ),
        RawAttention("derryhub", _DERRYHUB_NAME, "", _RAW, _DERRYHUB),
        RawAttention("derryhub-trt2", f"{_DERRYHUB_NAME}2", "", _RAW, _DERRYHUB),
        RawAttention(
            "dl4agx-uniad", _DERRYHUB_NAME, "",
            tuple(
                dataclasses.replace(each, types=(ir.DataType.INT64,))
                if each.types == INT32 else each for each in _RAW
            ),
            "DL4AGX uniad-trt",
        ),
        Dialect("msda-plugin", "MSDAPlugin", "", _operands(INT32), _DL4AGX),
        raw_own_form(),
    )  # fmt: skip

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Sample every level, with GridSample where sizes are constant, else Gather."""
        return sample_levels(call, *present(inputs))

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [N, Q, M, D] float64."""
        given = (np.asarray(each) for each in inputs)
        value, shapes, starts, locations, weights = given
        return sample_levels_array(
            value.astype(np.float64),
            shapes.astype(np.int64),
            starts.astype(np.int64),
            locations.astype(np.float64),
            weights.astype(np.float64),
        )
