"""Which operators TensorRT's ONNX parser takes, and of which element types.

From the support matrix of onnx-tensorrt, ``docs/operators.md``, of TensorRT 10.15;
what it takes that 10.1 (opset 20) did not is listed apart. An operator that stands in
neither list is unknown, and reported.
"""

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
"""Element types of the data that an operator takes; pairs have rules of their own."""

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
"""Operators that the matrix names and refuses."""
