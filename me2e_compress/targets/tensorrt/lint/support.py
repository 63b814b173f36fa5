"""Operators and plugins: known, of a type that is taken, called as they want."""

from collections.abc import Iterator

import onnx_ir as ir

from me2e_compress.targets.finding import (
    LintFinding,
    error,
    is_standard,
    nodes_of,
    warning,
)
from me2e_compress.targets.tensorrt.lint.operators import (
    LATER,
    SUPPORTED,
    UNSUPPORTED,
)
from me2e_compress.targets.tensorrt.lint.plugin_table import PLUGINS, Plugin

PAIRS = ("QuantizeLinear", "DequantizeLinear")
OPSETS = (9, 20, 24)
"""Oldest opset; newest of TensorRT 10.1; newest of 10.15."""

_DATA_INPUT = {"OneHot": 2, "Where": 1}
_TYPE_OF_OUTPUT = ("Constant", "ConstantOfShape", "If", "Loop", "RandomNormal")
_UNTYPED = ("RandomUniform", "Scan", "Shape", "Size")


def opset(model: ir.Model) -> Iterator[LintFinding]:
    """Hold the graph's opset against what parsers read."""
    found = model.opset_imports.get("", 0)
    oldest, newest, later = OPSETS
    if not oldest <= found <= later:
        yield error("opset", None, f"opset {found}: parsers read {oldest} to {later}")
    elif found > newest:
        yield warning(
            "opset", None, f"opset {found} needs TensorRT 10.15; 10.1 reads {newest}"
        )


def operators(model: ir.Model) -> Iterator[LintFinding]:
    """Find operators that the parser refuses or that nobody knows."""
    for node in nodes_of(model):
        if not is_standard(node) or node.op_type in PAIRS:
            continue
        name = node.op_type
        if name in UNSUPPORTED:
            yield error("operator", node, f"TensorRT's parser does not take {name}")
        elif name in LATER:
            yield warning(
                "operator", node, f"{name} needs TensorRT {LATER[name]} or later"
            )
        elif name not in SUPPORTED:
            yield error("operator", node, f"{name} is in no support matrix: unknown")


def element_types(model: ir.Model) -> Iterator[LintFinding]:
    """Find data of a type that its operator is not taken with."""
    for node in nodes_of(model):
        taken = SUPPORTED.get(node.op_type) if is_standard(node) else None
        kind = _data_type(node)
        if taken is None or kind is None or kind in taken:
            continue
        if kind == ir.DataType.DOUBLE:
            yield warning(
                "element-type", node, f"{node.op_type} of float64 is cast down"
            )
        elif node.op_type not in _UNTYPED:
            names = ", ".join(sorted(each.name.lower() for each in taken))
            yield error(
                "element-type",
                node,
                f"{node.op_type} of {kind.name.lower()}; it is taken with {names}",
            )


def one_type(model: ir.Model) -> Iterator[LintFinding]:
    """Find operators of two float types: networks are strongly typed."""
    floats = (ir.DataType.FLOAT, ir.DataType.FLOAT16, ir.DataType.BFLOAT16)
    for node in nodes_of(model):
        if not is_standard(node) or node.op_type in (*PAIRS, "CastLike", "Resize"):
            continue
        kinds = {each.dtype for each in node.inputs if each is not None}
        found = [each.name.lower() for each in floats if each in kinds]
        if len(found) > 1:
            yield error(
                "mixed-types",
                node,
                f"{node.op_type} of {' and '.join(found)}: one Cast",
            )


def plugins(model: ir.Model) -> Iterator[LintFinding]:
    """Hold custom operators against the plugins that are known."""
    for node in nodes_of(model):
        if is_standard(node):
            continue
        plugin = PLUGINS.get(node.op_type)
        if plugin is not None:
            yield from _call(node, plugin)
        elif node.op_identifier() not in model.functions:
            yield error(
                "plugin",
                node,
                f"{node.domain}::{node.op_type} is no operator, has no local function"
                " and is no plugin that is known",
            )


def _call(node: ir.Node, plugin: Plugin) -> Iterator[LintFinding]:
    name, (least, most) = f"{node.op_type} of {plugin.source}", plugin.inputs
    if not least <= len(node.inputs) <= most:
        wanted = f"{least}" if least == most else f"{least} to {most}"
        yield error(
            "plugin", node, f"{name} takes {wanted} inputs, not {len(node.inputs)}"
        )
        return
    if missing := [each for each in plugin.attributes if each not in node.attributes]:
        yield error("plugin", node, f"{name} wants attributes {', '.join(missing)}")
    first = node.inputs[0]
    kind = None if first is None else first.dtype
    if kind is not None and kind not in plugin.types:
        yield error("plugin", node, f"{name} does not take {kind.name.lower()}")
    rank = None if first is None or first.shape is None else len(first.shape)
    if None not in (rank, plugin.rank) and rank != plugin.rank:
        yield error("plugin", node, f"{name} takes rank {plugin.rank}, not {rank}")
    for index in plugin.integers:
        value = node.inputs[index]
        if value is not None and value.dtype not in (None, ir.DataType.INT32):
            yield error(
                "plugin",
                node,
                f"input {index} of {name} must be int32, not {value.dtype}",
            )


def _data_type(node: ir.Node) -> ir.DataType | None:
    if node.op_type in _TYPE_OF_OUTPUT:
        return node.outputs[0].dtype
    index = _DATA_INPUT.get(node.op_type, 0)
    value = node.inputs[index] if index < len(node.inputs) else None
    return None if value is None else value.dtype
