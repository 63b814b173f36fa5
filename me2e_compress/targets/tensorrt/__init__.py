"""TensorRT: int8 as explicit, symmetric QDQ, and what its parser would say of it."""

from me2e_compress.targets.tensorrt.place import kept_float, place, tensors

__all__ = ["kept_float", "place", "tensors"]
