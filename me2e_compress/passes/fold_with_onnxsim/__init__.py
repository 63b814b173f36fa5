"""onnxsim as an optional folding engine, at arm's length."""

from me2e_compress.passes.fold_with_onnxsim.fold import FoldWithOnnxsim

__all__ = ["FoldWithOnnxsim"]
