"""Check by NVIDIA's own ONNX parser and builder, on a CPU: those of TensorRT-RTX.

Its parser is of the same family as TensorRT's, and its builder compiles for a GPU that
is not there. It is not TensorRT: no timing and no fusion carries over, and it lacks the
plugin library, so the graph is cut at plugins.
"""

from me2e_compress.targets.tensorrt.rtx.check import SM, BuildResult, Kernel, check

__all__ = ["SM", "BuildResult", "Kernel", "check"]
