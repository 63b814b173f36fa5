"""Targets describe the form of graph that a runtime requires.

To add a target, write its class, then add it to this table.
"""

from me2e_compress.errors import RecipeError
from me2e_compress.registry import Registry
from me2e_compress.targets.base import (
    LintFinding,
    LintRule,
    Severity,
    Target,
    error,
    of_opset,
    valid,
    warning,
)

__all__ = [
    "DEFAULT_TARGET",
    "TARGETS",
    "LintFinding",
    "LintRule",
    "Severity",
    "Target",
    "error",
    "of_opset",
    "valid",
    "warning",
]

_HERE = "me2e_compress.targets"

DEFAULT_TARGET = "onnxruntime"
"""For whom int8 is written where nobody is named: who runs it on this machine."""

TARGETS: Registry[Target] = Registry(
    "target",
    _HERE,
    RecipeError,
    {
        "tensorrt": f"{_HERE}.tensorrt:TensorRT",
        "onnxruntime": f"{_HERE}.onnxruntime:OnnxRuntime",
    },
)
