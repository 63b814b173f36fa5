"""Would TensorRT's ONNX parser take a graph, and run as int8 what is meant to be?"""

from me2e_compress.targets.lint.finding import Rule
from me2e_compress.targets.lint.standard import of_opset, valid
from me2e_compress.targets.lint.tensorrt import pairs, placement, support
from me2e_compress.targets.lint.tensorrt.restrictions import restrictions

RULES: tuple[Rule, ...] = (
    valid,
    of_opset,
    support.opset,
    support.operators,
    support.element_types,
    support.one_type,
    support.plugins,
    restrictions,
    pairs.scales,
    pairs.zero_points,
    pairs.biases,
    pairs.scalars,
    pairs.completeness,
    pairs.integers,
    placement.channel_scales,
    placement.repeated_pairs,
    placement.outputs,
    placement.branches,
    placement.half_quantized,
    placement.float_weights,
)
