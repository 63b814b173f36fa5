"""Run any pass written for onnx-ir as a pass of this toolkit."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph import digest, provenance
from me2e_compress.passes.base import Context, Pass, PassResult

__all__ = ["OnnxIrPass"]


@dataclasses.dataclass(frozen=True)
class OnnxIrPass(Pass):
    """Run an onnx-ir pass; its changes are counted by comparing the graphs.

    Nodes that it changes name this pass. New nodes get no provenance: the manager
    refuses onnx-ir passes that make nodes without copying metadata.

    Given:   OnnxIrPass(onnx_ir.passes.common.IdentityEliminationPass())

    Result:  a pass that removes Identity nodes

    Attributes:
        inner: the pass; it must keep the outputs, as those in ``onnx_ir.passes.common``
            do.
    """

    name: ClassVar[str] = "onnx-ir-pass"
    exact: ClassVar[bool] = True
    inner: ir.passes.PassBase

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Run the inner pass."""
        before = model.clone()
        after = self.inner(model).model
        provenance.sign(before, after, self.name)
        return PassResult(after, int(digest(after) != digest(before)))
