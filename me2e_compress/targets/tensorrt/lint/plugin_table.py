"""The plugins that driving stacks are exported with, and what they take.

Names, inputs and attributes as in the source of TensorRT OSS 10.7, DerryHub's
BEVFormer_tensorrt, DL4AGX (``custom_op`` and exporter ops) and mmdeploy. TensorRT finds
a plugin by the node's operator name, ``plugin_version`` and ``plugin_namespace``.
"""

import dataclasses

import onnx_ir as ir

_FLOAT = frozenset({ir.DataType.FLOAT})
_HALF = _FLOAT | {ir.DataType.FLOAT16}
_INT8 = _HALF | {ir.DataType.INT8}


@dataclasses.dataclass(frozen=True)
class Plugin:
    """What a plugin takes.

    Attributes:
        source: which library has it.
        inputs: least and most number of inputs.
        attributes: that must be there.
        types: element types of its first input.
        rank: of its first input; None where any is taken.
        integers: inputs that must be int32.
    """

    source: str
    inputs: tuple[int, int]
    attributes: tuple[str, ...] = ()
    types: frozenset[ir.DataType] = _HALF
    rank: int | None = None
    integers: tuple[int, ...] = ()


_DERRYHUB, _OSS, _DL4AGX, _MMDEPLOY = (
    "BEVFormer_tensorrt", "TensorRT OSS", "DL4AGX", "mmdeploy",
)  # fmt: skip
_SAMPLER = ("interpolation_mode", "padding_mode", "align_corners")
_CONV = ("stride", "padding", "dilation")
_DEFORM = (*_CONV, "groups", "deform_groups")

_msda = Plugin(_DERRYHUB, (5, 5), types=_INT8, rank=4)
_rotate = Plugin(_DERRYHUB, (3, 3), ("interpolation",), _INT8, 3)
_sampler_2d = Plugin(_DERRYHUB, (2, 2), _SAMPLER, _INT8, 4)
_sampler_3d = Plugin(_DERRYHUB, (2, 2), _SAMPLER, _HALF, 5)
_deform = Plugin(_DERRYHUB, (4, 5), _DEFORM, _INT8, 4)
_attention = Plugin(_DERRYHUB, (3, 3), types=_INT8, rank=3)
_pool = Plugin(_DERRYHUB, (7, 7), ("out_height", "out_width"), _INT8)

PLUGINS: dict[str, Plugin] = {
    "BEVPoolV2TRT": _pool,
    "BEVPoolV2TRT2": _pool,
    "GridSampler2DTRT": _sampler_2d,
    "GridSampler2DTRT2": _sampler_2d,
    "GridSampler3DTRT": _sampler_3d,
    "GridSampler3DTRT2": _sampler_3d,
    "InverseTRT": Plugin(_DERRYHUB, (1, 1), types=_FLOAT, rank=4),
    "ModulatedDeformableConv2dTRT": _deform,
    "ModulatedDeformableConv2dTRT2": _deform,
    "MultiScaleDeformableAttnTRT": _msda,
    "MultiScaleDeformableAttnTRT2": _msda,
    "QKVTRT": _attention,
    "QKVTRT2": _attention,
    "RotateTRT": _rotate,
    "RotateTRT2": _rotate,
    "MultiscaleDeformableAttnPlugin_TRT": Plugin(_OSS, (5, 5), rank=4, integers=(1, 2)),
    "ModulatedDeformConv2d": Plugin(
        _OSS, (4, 5), (*_CONV, "group", "deformable_group"), rank=4
    ),
    "MultiScaleDeformableAttentionPlugin": Plugin(
        _DL4AGX, (5, 5), rank=4, integers=(1, 2)
    ),
    "RotatePlugin": Plugin(_DL4AGX, (3, 3), ("interpolation",), rank=3),
    "MMCVMultiScaleDeformableAttention": Plugin(
        _MMDEPLOY, (5, 5), rank=4, integers=(1, 2)
    ),
    "MMCVModulatedDeformConv2d": Plugin(_MMDEPLOY, (4, 5), _DEFORM, _FLOAT, 4),
    "grid_sampler": Plugin(_MMDEPLOY, (2, 2), _SAMPLER, _FLOAT, 4),
}
