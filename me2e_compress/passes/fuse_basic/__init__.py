"""Fuse what standard operators can say in one."""

import dataclasses
from collections import Counter
from collections.abc import Callable
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph import array_of
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.fuse_basic import activations, clip, linear
from me2e_compress.passes.fuse_basic.affine import fuse_affine
from me2e_compress.passes.fuse_basic.layer_norm import fuse_layer_norm
from me2e_compress.passes.fuse_basic.match import Site, maker
from me2e_compress.rewrite import graphs_of, is_standard, remove_dead

__all__ = ["FuseBasic"]

RULES: tuple[tuple[str, Callable[[ir.Node, Site], bool]], ...] = (
    ("layers with what follows them", fuse_affine),
    ("factors into MatMul weights", linear.fuse_scale),
    ("MatMul + bias", linear.fuse_gemm),
    ("layer normalizations", fuse_layer_norm),
    ("activations", activations.fuse_activation),
    ("Sigmoid", activations.fuse_sigmoid),
    ("Softplus", activations.fuse_softplus),
    ("Clip", clip.fuse_clip),
    ("constant chains", linear.fuse_chain),
)

ROUNDS = 16
"""A fusion can complete the pattern of another: real graphs need two or three."""


@dataclasses.dataclass(frozen=True)
class FuseBasic(Pass):
    """Fuse patterns of standard operators into fewer standard operators.

    Given:   Conv -> BatchNormalization -> Relu;  x * 0.5 * (1 + Erf(x / sqrt 2))
    Result:  Conv -> Relu;  Gelu(x) where the opset has it

    Equal up to rounding. A residual Conv + Add stays, in the shape that TensorRT and
    onnxruntime fuse with the activation behind it.

    Attributes:
        swish: write x * Sigmoid(x) as Swish where the opset has it (24); off, since
            onnxruntime (1.31) has no kernel for it.
    """

    name: ClassVar[str] = "fuse-basic"
    exact: ClassVar[bool] = True
    swish: bool = False

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Try every rule on every node until none applies."""
        opsets = model.opset_imports
        opset = opsets.get("", opsets.get("ai.onnx", 0))
        done: Counter[str] = Counter()
        refused: Counter[str] = Counter()
        for body in graphs_of(model.graph):
            refused_now: Counter[str] = Counter()
            for _ in range(ROUNDS):
                before = done.total()
                refused_now.clear()
                _round(Site(body, opset, self.name, self.swish, refused_now), done)
                if done.total() == before:
                    break
            refused.update(refused_now)
        if done:
            remove_dead(model.graph)
        residual = sum(_is_residual(node) for node in model.graph)
        return PassResult(model, done.total(), _notes(done, refused, residual))


def _round(site: Site, done: Counter[str]) -> None:
    for node in list(site.graph):
        if node.graph is not site.graph or not is_standard(node):
            continue
        for what, rule in RULES:
            if rule(node, site):
                done[what] += 1
                break


def _is_residual(node: ir.Node) -> bool:
    return (
        node.op_type == "Add"
        and any(maker(value, "Conv") for value in node.inputs)
        and all(array_of(value) is None for value in node.inputs)
    )


def _notes(done: Counter[str], refused: Counter[str], residual: int) -> tuple[str, ...]:
    notes = []
    if done:
        what = ", ".join(f"{count} {name}" for name, count in done.items())
        notes.append(f"fused: {what}")
    notes.extend(f"left {count}: {reason}" for reason, count in refused.items())
    if residual:
        notes.append(
            f"left {residual} residual Conv + Add as they are: TensorRT and onnxruntime"
            " fuse them with the activation behind"
        )
    return tuple(notes)
