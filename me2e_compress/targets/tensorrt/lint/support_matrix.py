"""Tables of the operators that TensorRT's ONNX parser supports, and of plugins.

Operators are those of onnx-tensorrt's support matrix, ``docs/operators.md``, of
TensorRT 10.15 (onnx/onnx-tensorrt fa5aa9f, the newest of which the sources could be
had), with what its importers (``onnxOpImporters.cpp`` and ``importerUtils.cpp`` of
10.1, 10.10 and 10.14 or later) take beyond it: integers in Clip (by Max and Min) and
NonZero, booleans in Equal and NonZero, convolutions and pools of one spatial dimension,
and ScatterElements with a reduction. What came after 10.1 has the version of its
changelog. Others are unknown, and reported. Names, inputs and attributes of plugins
come from the dialects of the fused operators. TensorRT finds a plugin by the node's
operator name, ``plugin_version`` and ``plugin_namespace``.
"""

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress.operators import OWN_DOMAIN, Dialect, operators
from me2e_compress.operators.dialect import INT32

_FLOAT = frozenset({ir.DataType.FLOAT, ir.DataType.FLOAT16, ir.DataType.BFLOAT16})
_HALF = _FLOAT - {ir.DataType.BFLOAT16}
_NUMBER = _FLOAT | {ir.DataType.INT32, ir.DataType.INT64}
_ANY = _NUMBER | {ir.DataType.BOOL}
_BOOL = frozenset({ir.DataType.BOOL})
_CAST = _ANY | {ir.DataType.UINT8}

_BY_TYPE: dict[frozenset[ir.DataType], str] = {
    _BOOL: "And Not Or Xor",
    _HALF: "DeformConv GridSample Mish NonMaxSuppression RoiAlign",
    _FLOAT: """
        Acos Acosh Asin Asinh Atan Atanh AveragePool BatchNormalization Ceil Celu
        Conv ConvTranspose Cos Cosh CumSum Dropout Einsum Elu Erf Exp Floor Gemm
        GlobalAveragePool GlobalLpPool GlobalMaxPool GroupNormalization GRU HardSigmoid
        HardSwish Hardmax InstanceNormalization IsInf LayerNormalization LeakyRelu Log
        LogSoftmax LRN LSTM LpNormalization LpPool MatMul MaxPool
        MeanVarianceNormalization PRelu RandomNormal RandomNormalLike RandomUniform
        RandomUniformLike Reciprocal Resize RNN Round Scan Selu Sigmoid Sin Sinh
        Softmax Softplus Softsign Sqrt Tan Tanh ThresholdedRelu Upsample
        """,
    _NUMBER: """
        Abs Add ArgMax ArgMin Clip DepthToSpace Div Gelu Greater GreaterOrEqual IsNaN
        Less LessOrEqual Max Mean Min Mod Mul Neg Pad Pow Range ReduceL1 ReduceL2
        ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd
        ReduceSum ReduceSumSquare Relu Scatter ScatterElements ScatterND Shrink Sign
        SpaceToDepth Sub Sum TopK
        """,
    _ANY: """
        Concat Constant ConstantOfShape Equal Expand EyeLike Flatten Gather
        GatherElements GatherND Identity If Loop NonZero OneHot Reshape
        ReverseSequence Shape Size Slice Split Squeeze Tile Transpose Trilu Unsqueeze
        Where
        """,
    _CAST: "Cast CastLike",
}

SUPPORTED: dict[str, frozenset[ir.DataType]] = {
    name: types for types, names in _BY_TYPE.items() for name in names.split()
}
"""Element types of the data that an operator accepts; pairs have their own rules."""

LATER: dict[str, str] = {
    **dict.fromkeys(("BlackmanWindow", "HammingWindow", "HannWindow"), "10.4"),
    "STFT": "10.5",
    "Attention": "10.14",
    **dict.fromkeys(("RMSNormalization", "RotaryEmbedding", "TensorScatter"), "10.15"),
}
"""Operators that TensorRT 10.1 did not support, and the version that brought them."""

TYPES_LATER: dict[str, tuple[frozenset[ir.DataType], str]] = {
    "Pow": (_NUMBER - _FLOAT, "10.12"),
}
"""Element types that came to an operator after 10.1, and the version that did it."""

NEWEST_OPSETS: dict[str, int] = {"10.1": 20, "10.15": 24, "11.5": 25}
"""Newest opset that the parser of a version reads (operators.md of 10.1 and of 10.15;
NVIDIA's "ONNX Opset Guide" of 11.x): one between two of them reads at least the older
one's."""

Version: TypeAlias = tuple[int, int]
"""Major and minor: patches change no table."""


def version_of(text: str) -> Version:
    """Read a version such as 10.13, or 10.13.3.9, whose last two numbers do not count.

    Raises:
        ValueError: it is no version.
    """
    if found := re.fullmatch(r"(\d{1,3})\.(\d{1,3})(\.\d{1,4}){0,2}", text):
        return int(found[1]), int(found[2])
    raise ValueError(f"{text!r} is no version of TensorRT, such as 10.13")


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


@dataclasses.dataclass(frozen=True)
class Plugin:
    """The inputs and attributes of a plugin.

    ``types`` and ``rank`` are those of its first input, where a rank of None accepts
    any; ``integers`` are the indices of inputs that must be int32.
    """

    source: str
    inputs: tuple[int, int]
    attributes: tuple[str, ...]
    types: frozenset[ir.DataType]
    rank: int | None
    integers: tuple[int, ...]


_OTHER_DOMAINS = (OWN_DOMAIN, "com.microsoft")
"""Domains whose operators are not TensorRT plugins."""


@functools.cache
def known_plugins() -> Mapping[str, Plugin]:
    """Return the plugins of all known dialects, by the operator's name.

    Where libraries share a name, anything that one of them accepts is allowed.
    """
    rows: dict[str, list[Dialect]] = {}
    for operator in operators():
        for dialect in operator.dialects:
            if dialect.domain not in _OTHER_DOMAINS:
                rows.setdefault(dialect.op_type, []).append(dialect)
    return {op_type: _plugin(dialects) for op_type, dialects in rows.items()}


def _plugin(dialects: Sequence[Dialect]) -> Plugin:
    # Libraries that share a name are merged to the widest form.
    first = dialects[0]
    least = min(sum(not each.optional for each in row.operands) for row in dialects)
    ranks = {row.operands[0].rank for row in dialects}
    return Plugin(
        first.source,
        (least, max(len(row.operands) for row in dialects)),
        tuple(each.name for each in first.attributes if each.required),
        frozenset(kind for row in dialects for kind in row.operands[0].types),
        ranks.pop() if len(ranks) == 1 else None,
        tuple(
            index
            for index, operand in enumerate(first.operands)
            if all(row.operands[index].types == INT32 for row in dialects)
            and not operand.optional
        ),
    )
