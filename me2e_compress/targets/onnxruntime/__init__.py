"""onnxruntime on the CPU: int8 where it has kernels for it, and in their form."""

from me2e_compress.targets.onnxruntime.census import int8_layers
from me2e_compress.targets.onnxruntime.convert import convert, unranged
from me2e_compress.targets.onnxruntime.place import kept_float, place, tensors

__all__ = ["convert", "int8_layers", "kept_float", "place", "tensors", "unranged"]
