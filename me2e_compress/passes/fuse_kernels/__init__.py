"""Fuse what onnxruntime's CPU runs slowly into operators with compiled kernels."""

import collections
import dataclasses
from collections.abc import Callable, Mapping

import onnx_ir as ir

from me2e_compress.base.display import plural
from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import graphs_of, opset_of
from me2e_compress.graph.nodes import is_standard
from me2e_compress.graph.rewrite import remove_dead, replace_value, value_names
from me2e_compress.operators import OWN_DOMAIN, FusedCall
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.fuse_kernels.attention import fuse_attention
from me2e_compress.passes.fuse_kernels.grid_sample import fuse_grid_sample
from me2e_compress.passes.fuse_kernels.raw_attention import fuse_raw_attention

__all__ = ["FuseKernels"]

# Writes the fused node of a pattern that ends at a node, and returns its result.
#
# None where the node is no such pattern; a PreconditionError names what an almost
# matching one lacks. Nothing may be written before the last check.
Fuser = Callable[[ir.Node, FusedCall], ir.Value | None]

# Fusers by the type of the last node of their pattern.
_FUSERS: Mapping[str, Fuser] = {
    "GridSample": fuse_grid_sample,
    "MatMul": fuse_attention,
    "MultiScaleDeformableAttention": fuse_raw_attention,
}


@dataclasses.dataclass(frozen=True)
class FuseKernels(Pass):
    """Fuse float operators that compiled kernels run faster than onnxruntime's own.

    Given:   y = MatMul(Softmax(MatMul(q, k^T) / sqrt(C)), v)

    Result:  y = me2e::MultiHeadAttention(q, k, v)

    Likewise GridSample of feature maps, and the sums, softmax and mask in front of
    deformable attention, which its kernel reads unrepeated
    (``me2e::RawDeformableAttention``).

    It stands last in a recipe, behind quantization: what is int8 stays as it is. The
    bodies of the fused nodes are the standard operators that they replace, so a file
    with ``attach-bodies`` behind it runs everywhere.
    """

    name = "fuse-kernels"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Try every node of the graph and of its bodies."""
        # Try the fuser of every operator; an almost matching one says why it stays
        opset, names = opset_of(model), value_names(model.graph)
        done: collections.Counter[str] = collections.Counter()
        rejected: list[str] = []
        for body in graphs_of(model.graph):
            for node in list(body):
                known = is_standard(node) or node.domain == OWN_DOMAIN
                fuser = _FUSERS.get(node.op_type) if known else None
                if node.graph is not body or fuser is None:
                    continue
                call = FusedCall(node, opset=opset, by=self.name, names=names)
                try:
                    new = fuser(node, call)
                except PreconditionError as error:
                    rejected.append(f"left {node.name}: {error}")
                    continue
                if new is not None:
                    replace_value(node.outputs[0], new)
                    done[node.op_type] += 1
        if done:
            model.opset_imports.setdefault(OWN_DOMAIN, 1)
            remove_dead(model.graph)
        notes = [f"fused: {plural(n, kind)}" for kind, n in sorted(done.items())]
        return PassResult(model, done.total(), (*notes, *rejected))
