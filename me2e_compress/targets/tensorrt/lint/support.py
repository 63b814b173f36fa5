"""Parser support: operators, plugins, opsets, types, and restrictions.

Tables of the operators that TensorRT's ONNX parser supports, and of plugins.

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
import re
from collections.abc import Callable, Iterator
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import array_of, input_at, is_standard, nodes_of, rank_of
from me2e_compress.graph.nodes import is_plugin
from me2e_compress.graph.opset import on_disk
from me2e_compress.graph.shapes import unshaped_plugins
from me2e_compress.operators import RESERVED, Dialect, find
from me2e_compress.targets import (
    LintFinding,
    LintRule,
    divided_grids,
    error,
    of_opset,
    rule_of_nodes,
    valid,
    warning,
)
from me2e_compress.targets.quantized import PAIR
from me2e_compress.targets.tensorrt.lint import qdq

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

# Element types of the data that an operator accepts; pairs have their own rules
SUPPORTED: dict[str, frozenset[ir.DataType]] = {
    name: types for types, names in _BY_TYPE.items() for name in names.split()
}

# Operators that TensorRT 10.1 did not support, and the version that brought them
LATER: dict[str, str] = {
    **dict.fromkeys(("BlackmanWindow", "HammingWindow", "HannWindow"), "10.4"),
    "STFT": "10.5",
    "Attention": "10.14",
    **dict.fromkeys(("RMSNormalization", "RotaryEmbedding", "TensorScatter"), "10.15"),
}

# Element types that came to an operator after 10.1, and the version that did it
TYPES_LATER: dict[str, tuple[frozenset[ir.DataType], str]] = {
    "Pow": (_NUMBER - _FLOAT, "10.12")
}

# Newest opset that the parser of a version reads (operators.md of 10.1 and of 10.15;
# NVIDIA's "ONNX Opset Guide" of 11.x): one between two of them reads at least the older
# one's
NEWEST_OPSETS: dict[str, int] = {"10.1": 20, "10.15": 24, "11.5": 25}

Version: TypeAlias = tuple[int, int]  # major and minor: patches change no table


def version_of(text: str) -> Version:
    """Read a version such as 10.13, or 10.13.3.9, whose last two numbers do not count.

    Raises:
        ValueError: it is no version.
    """
    if match := re.fullmatch(r"(\d{1,3})\.(\d{1,3})(\.\d{1,4}){0,2}", text):
        return int(match[1]), int(match[2])
    raise ValueError(f"{text!r} is no version of TensorRT, such as 10.13")


# Operators that the matrix lists as not supported
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


OLDEST_OPSET = 9

_DATA_INPUT = {"OneHot": 2, "Where": 1}
_TYPE_OF_OUTPUT = ("Constant", "ConstantOfShape", "If", "Loop", "RandomNormal")
_UNTYPED = ("RandomUniform", "Scan", "Shape", "Size")


@dataclasses.dataclass(frozen=True)
class Parser:
    """What the parser of one version takes; of None, what came late is a warning."""

    version: Version | None = None

    def opset(self, model: ir.Model) -> Iterator[LintFinding]:
        """Check the graph's opset against those that parsers read."""
        (_, opset), last = on_disk(model), max(NEWEST_OPSETS.values())
        if not OLDEST_OPSET <= opset <= last:
            message = f"opset {opset}: parsers read {OLDEST_OPSET} to {last}"
            if opset < OLDEST_OPSET:
                yield error("opset", None, message)
            else:
                more = "; TensorRT-RTX 1.7 parses newer (measured)"
                yield warning("opset", None, f"{message}, by their pages{more}")
            return
        # Never an error: some version in between began to read it
        since = next(name for name, newest in NEWEST_OPSETS.items() if opset <= newest)
        oldest = next(iter(NEWEST_OPSETS))
        is_older = self.version is None or self.version < version_of(since)
        if since != oldest and is_older:
            text = f"TensorRT {since} reads it, {oldest} reads {NEWEST_OPSETS[oldest]}"
            yield warning("opset", None, f"opset {opset}: {text}")

    def operators(self, model: ir.Model) -> Iterator[LintFinding]:
        """Find operators that the parser refuses, or that are unknown."""
        for node in nodes_of(model):
            if is_plugin(node) or node.op_type in PAIR:
                continue
            name = node.op_type
            if name in UNSUPPORTED:
                yield error("operator", node, f"TensorRT's parser does not take {name}")
            elif name in LATER:
                yield from self._late("operator", node, name, LATER[name])
            elif name not in SUPPORTED:
                yield error("operator", node, f"{name} stands in no support matrix")

    def element_types(self, model: ir.Model) -> Iterator[LintFinding]:
        """Find data of a type that its operator does not accept."""
        for node in nodes_of(model):
            types = SUPPORTED.get(node.op_type) if is_standard(node) else None
            value = input_at(node, _DATA_INPUT.get(node.op_type, 0))
            if node.op_type in _TYPE_OF_OUTPUT:
                value = node.outputs[0]
            kind = None if value is None else value.dtype
            if types is None or kind is None:
                continue
            what = f"{node.op_type} of {kind.name.lower()}"
            late, since = TYPES_LATER.get(node.op_type, (frozenset(), ""))
            if kind in late:
                yield from self._late("element-type", node, what, since)
            elif kind == ir.DataType.DOUBLE:  # TensorRT casts it down by itself
                message = f"{node.op_type} of float64 is cast down"
                yield warning("element-type", node, message)
            elif kind not in types and node.op_type not in _UNTYPED:
                names = ", ".join(sorted(other.name.lower() for other in types))
                yield error("element-type", node, f"{what}; it accepts {names}")

    def _late(
        self, rule: str, node: ir.Node | None, what: str, since: str
    ) -> Iterator[LintFinding]:
        """Yield that something needs a version: an error if the parser is older."""
        message = f"{what} needs TensorRT {since} or later"
        if self.version is None:
            yield warning(rule, node, message)
        elif self.version < version_of(since):
            own = ".".join(map(str, self.version))
            yield error(rule, node, f"{message}, not {own}")


@rule_of_nodes("mixed-types", "error")
def one_type(node: ir.Node) -> Iterator[str]:
    """Find operators with two float types: networks are strongly typed."""
    if not is_standard(node) or node.op_type in (*PAIR, "CastLike", "Resize"):
        return
    # Integers do not matter, only float types
    floats = (ir.DataType.FLOAT, ir.DataType.FLOAT16, ir.DataType.BFLOAT16)
    kinds = {value.dtype for value in node.inputs if value is not None}
    names = [kind.name.lower() for kind in floats if kind in kinds]
    if len(names) > 1:
        yield f"{node.op_type} of {' and '.join(names)}: cast one of them"


def plugins(model: ir.Model) -> Iterator[LintFinding]:
    """Check custom operators against the known plugins, whatever their domain."""
    # TensorRT looks at the name alone; exporters leave the domain out
    for node in filter(is_plugin, nodes_of(model)):
        dialect = _plugin(node)
        if dialect is not None:
            for message in _misfits(node, dialect):
                yield error("plugin", node, message)
        # A local function makes an unknown operator acceptable
        elif node.op_identifier() not in model.functions:
            name = f"{node.domain or 'ai.onnx'}::{node.op_type}"
            message = "is neither an operator nor a known plugin, and has no local"
            yield error("plugin", node, f"{name} {message} function")


def _plugin(node: ir.Node) -> Dialect | None:
    """Return the plugin of a node's name, of several the one that fits it best."""
    match = find(node)
    return None if match is None or match[1].domain in RESERVED else match[1]


def _misfits(node: ir.Node, dialect: Dialect) -> Iterator[str]:
    """Yield where a node does not fit a plugin."""
    name = f"{node.op_type} of {dialect.source}"
    required = [attr.name for attr in dialect.attributes if attr.required]
    if missing := [attr for attr in required if attr not in node.attributes]:
        yield f"{name} needs attributes {', '.join(missing)}"
    try:
        dialect.check(node)
    except PreconditionError as refusal:
        yield str(refusal).replace(dialect.call_of(node), name, 1)


@rule_of_nodes("plugin-shape", "warning", unshaped_plugins)
def plugin_shapes(node: ir.Node) -> Iterator[str]:
    """Find known plugins whose outputs have no shape, nor what follows them."""
    if _plugin(node) is not None:
        yield (
            f"{node.op_type} tells no shape of what it gives: written as value_info,"
            " folding, MACs and int8 go on behind it"
        )


MAX_K = 3840  # largest K of a TopK

_RESIZE_MODES = ("nearest", "linear")
_RESIZE_TRANSFORMS = (
    "half_pixel", "pytorch_half_pixel", "tf_half_pixel_for_nn", "asymmetric",
    "align_corners",
)  # fmt: skip


@rule_of_nodes("restriction", "error")
def restrictions(node: ir.Node) -> Iterator[str]:
    """Check a node against the restrictions on its operator."""
    for check in _CHECKS.get(node.op_type, ()) if is_standard(node) else ():
        if objection := check(node):
            yield f"{node.op_type}: {objection}"


@rule_of_nodes("rtx", "warning")
def rtx(node: ir.Node) -> Iterator[str]:
    """Find what TensorRT takes, and TensorRT-RTX 1.7 does not: measured."""
    reason, value = "", input_at(node, 0)
    is_float = value is not None and value.dtype == ir.DataType.FLOAT
    if node.op_type == "Attention" and is_float:
        reason = "is parsed, and not built, of float32: convert-float16 helps"
    elif node.op_type == "ScatterElements" and _no_reduction(node):
        reason = "is not parsed with a reduction"
    if reason and is_standard(node):
        yield f"{node.op_type} {reason}, by TensorRT-RTX 1.7 (measured)"


# Restrictions of operators: what is wrong with a node, or None


def _image(node: ir.Node) -> str | None:
    """Check for at most three spatial dimensions; one is made two by the parser."""
    rank = rank_of(node.inputs[0])
    return None if rank in (None, 3, 4, 5) else f"rank {rank}, must be 3, 4 or 5"


def _four(node: ir.Node) -> str | None:
    """Check for two spatial dimensions."""
    rank = rank_of(node.inputs[0])
    return None if rank in (None, 4) else f"rank {rank}, must be 4"


def _undilated(node: ir.Node) -> str | None:
    dilations = node.attributes.get_ints("dilations", ())
    return None if set(dilations) <= {1} else f"dilations {list(dilations)}, must be 1"


def _first_output(node: ir.Node) -> str | None:
    extra = [value for value in node.outputs[1:] if value.name]
    return None if not extra else "only the first output is supported"


def _constant(index: int, name: str) -> Callable[[ir.Node], str | None]:
    def check(node: ir.Node) -> str | None:
        value = input_at(node, index)
        computed = value is not None and array_of(value) is None
        return f"{name} is computed, must be a constant" if computed else None

    return check


def _top_k(node: ir.Node) -> str | None:
    if node.attributes.get_int("sorted", 1) != 1:
        return "sorted must be 1"
    k = array_of(node.inputs[1])
    number = 0 if k is None else int(k.reshape(-1)[0])
    return f"K = {number}, at most {MAX_K}" if number > MAX_K else None


def _no_reduction(node: ir.Node) -> str | None:
    reduction = node.attributes.get_string("reduction", "none")
    return None if reduction == "none" else f"reduction {reduction}, must be none"


def _no_layout(node: ir.Node) -> str | None:
    return "layout must be 0" if node.attributes.get_int("layout", 0) else None


def _resize(node: ir.Node) -> str | None:
    text = node.attributes.get_string
    mode = text("mode", "nearest")
    if mode not in _RESIZE_MODES:
        return f"mode {mode}, must be {' or '.join(_RESIZE_MODES)}"
    transform = text("coordinate_transformation_mode", "half_pixel")
    if transform not in _RESIZE_TRANSFORMS:
        return f"coordinates {transform}, must be of {', '.join(_RESIZE_TRANSFORMS)}"
    policy = text("keep_aspect_ratio_policy", "stretch")
    if policy != "stretch":
        return f"aspect ratio policy {policy}, must be stretch"
    return "antialias must be 0" if node.attributes.get_int("antialias", 0) else None


def _even_pads(node: ir.Node) -> str | None:
    pads = tuple(node.attributes.get_ints("pads", ()))
    half = len(pads) // 2
    uneven = pads[:half] != pads[half:]
    return f"pads {list(pads)} differ between begin and end" if uneven else None


_CHECKS: dict[str, tuple[Callable[[ir.Node], str | None], ...]] = {
    "AveragePool": (_image, _undilated),
    "Conv": (_image,),
    "ConvTranspose": (_image,),
    "CumSum": (_constant(1, "axis"),),
    "DeformConv": (_even_pads,),
    "GridSample": (_four,),
    "LSTM": (_no_layout,),
    "LayerNormalization": (_first_output,),
    "LpPool": (_undilated,),
    "MaxPool": (_image, _undilated, _first_output),
    "OneHot": (_constant(1, "depth"),),
    "Resize": (_resize,),
    "ScatterND": (_no_reduction,),
    "Squeeze": (_constant(1, "axes"),),
    "TopK": (_top_k,),
    "Unsqueeze": (_constant(1, "axes"),),
    **{name: (_constant(1, "axes"),) for name in SUPPORTED if name[:6] == "Reduce"},
}  # fmt: skip


def rules(version: Version | None) -> tuple[LintRule, ...]:
    """Return the rules for a version of TensorRT; None for any since 10.1."""
    parser = Parser(version)
    tables = (parser.opset, parser.operators, parser.element_types)
    shapes = (one_type, plugins, plugin_shapes, restrictions, rtx)
    return (valid, of_opset, divided_grids, *tables, *shapes, *qdq.RULES)
