"""Check graphs with the ONNX parser and builder of TensorRT-RTX, on a CPU.

Its parser is of the same family as TensorRT's, and its builder compiles for a GPU that
is not present. It is not TensorRT: timings and fusions do not carry over, and it lacks
the plugin library, so the graph is cut at plugins.
"""

from me2e_compress.targets.tensorrt.rtx.check import SM, BuildResult, Kernel, check

__all__ = ["SM", "BuildResult", "Kernel", "check"]
