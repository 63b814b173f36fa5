"""Compiled kernels of fused operators, run by ordinary onnxruntime sessions.

A session calls them on its own threads for the nodes of
:data:`~me2e_compress.operators.kernels.kernel.DOMAIN`.
"""

from me2e_compress.operators.kernels.kernel import DOMAIN, KERNELS, CompiledKernel
from me2e_compress.operators.kernels.trampoline import why_not

__all__ = ["DOMAIN", "KERNELS", "CompiledKernel", "why_not"]
