"""Fuse patterns that one standard operator can express."""

import dataclasses

import onnx_ir as ir

from me2e_compress.graph import array_of
from me2e_compress.graph.nodes import maker
from me2e_compress.graph.rewrite import Fusion, fuse
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.fuse_basic import constants, weights

__all__ = ["FuseBasic"]


@dataclasses.dataclass(frozen=True)
class FuseBasic(Pass):
    """Fuse patterns of standard operators into fewer standard operators.

    Given:   Conv -> BatchNormalization -> Relu;  MatMul(x, w) + b of rank 2

    Result:  Conv -> Relu;  Gemm(x, w, b)

    Outputs are equal up to rounding. Gelu and LayerNormalization stay decomposed where
    they are: runtimes find them. A residual Conv + Add stays, in the form that TensorRT
    and onnxruntime fuse with the next activation.
    """

    name = "fuse-basic"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Try every fusion on every node until none applies."""
        fused = fuse(model, self.fusions(), by=self.name)
        residual = sum(
            node.op_type == "Add"
            and any(maker(value, "Conv") for value in node.inputs)
            and all(array_of(value) is None for value in node.inputs)
            for node in model.graph
        )
        left = (
            f"left {residual} residual Conv + Add as they are: TensorRT and onnxruntime"
            " fuse them with the activation behind",
        )
        notes = (*fused.notes(), *(left if residual else ()))
        return PassResult(model, fused.changes, notes)

    def fusions(self) -> tuple[Fusion, ...]:
        """Return the fusions in the order in which they are tried."""
        return (*weights.FUSIONS, constants.GEMM, *constants.FUSIONS)
