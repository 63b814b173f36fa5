"""Lint rules: does TensorRT's parser accept a graph, and is its int8 run as int8?"""

from me2e_compress.targets.base import LintRule, of_opset, valid
from me2e_compress.targets.tensorrt.lint import qdq, support
from me2e_compress.targets.tensorrt.lint.support import Version

_RULES: tuple[LintRule, ...] = (
    support.one_type,
    support.plugins,
    support.plugin_shapes,
    support.restrictions,
    qdq.scales,
    qdq.zero_points,
    qdq.biases,
    qdq.scalars,
    qdq.completeness,
    qdq.integers,
    qdq.channel_scales,
    qdq.repeated_pairs,
    qdq.outputs,
    qdq.branches,
    qdq.half_quantized,
    qdq.float_weights,
)


def rules(version: Version | None) -> tuple[LintRule, ...]:
    """Return the rules for a version of TensorRT; None for any since 10.1."""
    parser = support.Parser(version)
    tables = (parser.opset, parser.operators, parser.element_types)
    return (valid, of_opset, *tables, *_RULES)
