"""Use any pass written for onnx-ir."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph import digest
from me2e_compress.passes.base import Context, Pass, PassResult

__all__ = ["OnnxIrPass"]


@dataclasses.dataclass(frozen=True)
class OnnxIrPass(Pass):
    """Run an onnx-ir pass and count its changes by the graph itself.

    Given:   OnnxIrPass(onnx_ir.passes.common.IdentityEliminationPass())
    Result:  the same as a pass of this package; new nodes get no past, so that the
             manager refuses onnx-ir passes that make nodes without copying metadata

    Attributes:
        inner: the pass; it must keep the outputs, as those in ``onnx_ir.passes.common``
            do.
    """

    name: ClassVar[str] = "onnx-ir-pass"
    exact: ClassVar[bool] = True
    inner: ir.passes.PassBase

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Delegate."""
        before = digest(model)
        after = self.inner(model).model
        return PassResult(after, int(digest(after) != before))
