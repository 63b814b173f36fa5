"""Rules of TensorRT: would its parser take a graph, and run its int8 as int8?"""

from me2e_compress.targets.base import LintRule, of_opset, valid
from me2e_compress.targets.tensorrt.lint import (
    placement,
    qdq,
    support,
)
from me2e_compress.targets.tensorrt.lint.restrictions import restrictions

RULES: tuple[LintRule, ...] = (
    valid,
    of_opset,
    support.opset,
    support.operators,
    support.element_types,
    support.one_type,
    support.plugins,
    restrictions,
    qdq.scales,
    qdq.zero_points,
    qdq.biases,
    qdq.scalars,
    qdq.completeness,
    qdq.integers,
    placement.channel_scales,
    placement.repeated_pairs,
    placement.outputs,
    placement.branches,
    placement.half_quantized,
    placement.float_weights,
)
