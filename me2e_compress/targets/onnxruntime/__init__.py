"""onnxruntime on the CPU: int8 in the form for which it has kernels."""

from me2e_compress.targets.onnxruntime.convert import convert, int8_layers, unranged
from me2e_compress.targets.onnxruntime.int8_rewrites import int8_rewrites
from me2e_compress.targets.onnxruntime.place import OnnxRuntime
from me2e_compress.targets.onnxruntime.slow_form import slow_here

__all__ = [
    "OnnxRuntime",
    "convert",
    "int8_layers",
    "int8_rewrites",
    "slow_here",
    "unranged",
]
