"""A fusion as a pattern: what to look for, and what takes its place."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph.rewrite import Fusion, fuse, op, var
from me2e_compress.passes import Context, Pass, PassResult

X = var("x")
RELU_PAIR = Fusion(
    "Relu of Relu",
    op("Relu", op("Relu", X)),
    lambda match, kit: kit.replace_by("Relu", [match[X]]),
)


@dataclasses.dataclass(frozen=True)
class FuseReluPairs(Pass):
    """Fuse a Relu with the Relu before it.

    Given:   y = Relu(Relu(x))
    Result:  y = Relu(x)
    """

    name: ClassVar[str] = "fuse-relu-pairs"
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Fuse until nothing matches."""
        fused = fuse(model, (RELU_PAIR,), by=self.name)
        return PassResult(model, fused.changes, fused.notes())
