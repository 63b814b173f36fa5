"""Tables: the operators that TensorRT's ONNX parser takes, and known plugins.

Operators are those of the support matrix of onnx-tensorrt, ``docs/operators.md``, of
TensorRT 10.15; what it takes that 10.1 (opset 20) did not is listed apart. An operator
that stands in neither list is unknown, and reported.

Plugins have names, inputs and attributes as in the source of TensorRT OSS 10.7,
DerryHub's BEVFormer_tensorrt, DL4AGX (``custom_op`` and exporter ops) and mmdeploy.
TensorRT finds a plugin by the node's operator name, ``plugin_version`` and
``plugin_namespace``.
"""

import dataclasses

import onnx_ir as ir

_FLOAT = frozenset({ir.DataType.FLOAT, ir.DataType.FLOAT16, ir.DataType.BFLOAT16})
_HALF = _FLOAT - {ir.DataType.BFLOAT16}
_NUMBER = _FLOAT | {ir.DataType.INT32, ir.DataType.INT64}
_ANY = _NUMBER | {ir.DataType.BOOL}
_BOOL = frozenset({ir.DataType.BOOL})
_CAST = _ANY | {ir.DataType.UINT8}

_BY_TYPE: dict[frozenset[ir.DataType], str] = {
    _BOOL: "And Not Or Xor",
    _HALF: "DeformConv GridSample Mish NonMaxSuppression NonZero RoiAlign",
    _FLOAT: """
        Acos Acosh Asin Asinh Atan Atanh AveragePool BatchNormalization Ceil Celu Clip
        Conv ConvTranspose Cos Cosh CumSum Dropout Einsum Elu Erf Exp Floor Gemm
        GlobalAveragePool GlobalLpPool GlobalMaxPool GroupNormalization GRU HardSigmoid
        HardSwish Hardmax InstanceNormalization IsInf LayerNormalization LeakyRelu Log
        LogSoftmax LRN LSTM LpNormalization LpPool MatMul MaxPool
        MeanVarianceNormalization PRelu RandomNormal RandomNormalLike RandomUniform
        RandomUniformLike Reciprocal Resize RNN Round Scan Selu Sigmoid Sin Sinh
        Softmax Softplus Softsign Sqrt Tan Tanh ThresholdedRelu Upsample
        """,
    _NUMBER: """
        Abs Add ArgMax ArgMin DepthToSpace Div Equal Gelu Greater GreaterOrEqual IsNaN
        Less LessOrEqual Max Mean Min Mod Mul Neg Pad Pow Range ReduceL1 ReduceL2
        ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd
        ReduceSum ReduceSumSquare Relu Scatter ScatterElements ScatterND Shrink Sign
        SpaceToDepth Sub Sum TopK
        """,
    _ANY: """
        Concat Constant ConstantOfShape Expand EyeLike Flatten Gather GatherElements
        GatherND Identity If Loop OneHot Reshape ReverseSequence Shape Size Slice Split
        Squeeze Tile Transpose Trilu Unsqueeze Where
        """,
    _CAST: "Cast CastLike",
}

SUPPORTED: dict[str, frozenset[ir.DataType]] = {
    name: types for types, names in _BY_TYPE.items() for name in names.split()
}
"""Element types of the data that an operator accepts; pairs have their own rules."""

LATER: dict[str, str] = dict.fromkeys(
    (
        "Attention", "BlackmanWindow", "HammingWindow", "HannWindow",
        "RMSNormalization", "RotaryEmbedding", "STFT", "TensorScatter",
    ),
    "10.15",
)  # fmt: skip
"""Operators that TensorRT 10.1 did not take, and the version whose matrix has them."""

UNSUPPORTED = frozenset(
    {
        "AffineGrid", "Bernoulli", "BitCast", "BitShift", "BitwiseAnd",
        "BitwiseNot", "BitwiseOr", "BitwiseXor", "CenterCropPad", "Col2Im",
        "Compress", "ConcatFromSequence", "ConvInteger", "CumProd", "DFT",
        "Det", "DynamicQuantizeLinear", "ImageDecoder", "MatMulInteger",
        "MaxRoiPool", "MaxUnpool", "MelWeightMatrix", "Multinomial",
        "NegativeLogLikelihoodLoss", "Optional", "OptionalGetElement",
        "OptionalHasElement", "QLinearConv", "QLinearMatMul", "RegexFullMatch",
        "SequenceAt", "SequenceConstruct", "SequenceEmpty", "SequenceErase",
        "SequenceInsert", "SequenceLength", "SequenceMap",
        "SoftmaxCrossEntropyLoss", "SplitToSequence", "StringConcat",
        "StringNormalizer", "StringSplit", "TfIdfVectorizer", "Unique",
    }
)  # fmt: skip
"""Operators that the matrix lists as not supported."""

_PLUGIN_FLOAT = frozenset({ir.DataType.FLOAT})
_PLUGIN_HALF = _PLUGIN_FLOAT | {ir.DataType.FLOAT16}
_PLUGIN_INT8 = _PLUGIN_HALF | {ir.DataType.INT8}


@dataclasses.dataclass(frozen=True)
class Plugin:
    """The inputs and attributes of a plugin.

    Attributes:
        source: which library has it.
        inputs: least and most number of inputs.
        attributes: those that are required.
        types: element types of its first input.
        rank: of its first input; None where any is taken.
        integers: inputs that must be int32.
    """

    source: str
    inputs: tuple[int, int]
    attributes: tuple[str, ...] = ()
    types: frozenset[ir.DataType] = _PLUGIN_HALF
    rank: int | None = None
    integers: tuple[int, ...] = ()


_DERRYHUB, _OSS, _DL4AGX, _MMDEPLOY = (
    "BEVFormer_tensorrt", "TensorRT OSS", "DL4AGX", "mmdeploy",
)  # fmt: skip
_SAMPLER = ("interpolation_mode", "padding_mode", "align_corners")
_CONV = ("stride", "padding", "dilation")
_DEFORM = (*_CONV, "groups", "deform_groups")

_msda = Plugin(_DERRYHUB, (5, 5), types=_PLUGIN_INT8, rank=4)
_rotate = Plugin(_DERRYHUB, (3, 3), ("interpolation",), _PLUGIN_INT8, 3)
_sampler_2d = Plugin(_DERRYHUB, (2, 2), _SAMPLER, _PLUGIN_INT8, 4)
_sampler_3d = Plugin(_DERRYHUB, (2, 2), _SAMPLER, _PLUGIN_HALF, 5)
_deform = Plugin(_DERRYHUB, (4, 5), _DEFORM, _PLUGIN_INT8, 4)
_attention = Plugin(_DERRYHUB, (3, 3), types=_PLUGIN_INT8, rank=3)
_pool = Plugin(_DERRYHUB, (7, 7), ("out_height", "out_width"), _PLUGIN_INT8)

PLUGINS: dict[str, Plugin] = {
    "BEVPoolV2TRT": _pool,
    "BEVPoolV2TRT2": _pool,
    "GridSampler2DTRT": _sampler_2d,
    "GridSampler2DTRT2": _sampler_2d,
    "GridSampler3DTRT": _sampler_3d,
    "GridSampler3DTRT2": _sampler_3d,
    "InverseTRT": Plugin(_DERRYHUB, (1, 1), types=_PLUGIN_FLOAT, rank=4),
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
    "MSDAPlugin": Plugin(_DL4AGX, (5, 5), rank=4, integers=(1, 2)),
    "GridSamplePlugin": Plugin(_DL4AGX, (2, 2)),
    "InversePlugin": Plugin(_DL4AGX, (1, 1), types=_PLUGIN_FLOAT),
    "SelectAndPadPlugin": Plugin(_DL4AGX, (3, 3), ("P",), integers=(1,)),
    "RotatePlugin": Plugin(_DL4AGX, (3, 3), ("interpolation",), rank=3),
    "MMCVMultiScaleDeformableAttention": Plugin(
        _MMDEPLOY, (5, 5), rank=4, integers=(1, 2)
    ),
    "MMCVModulatedDeformConv2d": Plugin(_MMDEPLOY, (4, 5), _DEFORM, _PLUGIN_FLOAT, 4),
    "grid_sampler": Plugin(_MMDEPLOY, (2, 2), _SAMPLER, _PLUGIN_FLOAT, 4),
}
