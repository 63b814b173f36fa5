"""Fuse decomposed operators into the fused operators of the toolkit."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence

import onnx_ir as ir

from me2e_compress.base.errors import GraphError, PreconditionError
from me2e_compress.graph import graphs_of, is_standard, opset_of
from me2e_compress.graph.nodes import is_read, nodes_in
from me2e_compress.graph.provenance import inherit
from me2e_compress.graph.rewrite import (
    remove_dead,
    replace_value,
    value_names,
)
from me2e_compress.operators import OWN_DOMAIN, FusedCall
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.fuse_operators import decomposed, fused_form, gathered
from me2e_compress.passes.fuse_operators.numeric_check import (
    Draw,
    Proofs,
    draw_views,
    nodes_between,
    take_back,
)

__all__ = ["FuseOperators"]

# Largest difference, relative to the largest result: the cost of summing float32 in
# another order, and of rounding positions on the way to -1..1 and back.
TOLERANCE = 1e-4


@dataclasses.dataclass(frozen=True)
class FuseOperators(Pass):
    """Fuse decomposed multi-scale deformable attention into one node.

    Given:   g_l = 2 * locations[level l] - 1;  s_l = GridSample(value[level l], g_l);
             y = ReduceSum(Concat(s_0, s_1, ...) * weights, axes=[-1])

    Result:  y = me2e::MultiScaleDeformableAttention(
                 value, spatial_shapes, level_start_index, locations, weights)

    This is first a correctness fix for TensorRT: deformable attention decomposed into
    GridSample is reported silently wrong from TensorRT 10.14 to 11.1 (NVIDIA/TensorRT
    issue 4813). ``translate-plugins`` turns the fused node into the plugin's node.

    Bilinear sampling that is written with Gather (floors, four corners, their shares,
    zeros outside) is GridSample first, from opset 16 on, if that is proven likewise.

    Matches are found by what nodes compute, whatever the exporter and the names: from
    each GridSample (bilinear, zeros outside, corners not aligned) through operators
    that only move elements, with one level or several, with heads in the batch or
    separate. Each match is verified: the nodes and the fused node's body run on the
    same random numbers, including positions outside the feature maps; if they differ
    the nodes stay. The notes name every GridSample that stays, and why.

    The sum, or mean, over cameras or frames that follows is included, and the mask
    before it: each image is then one more level, and the results of single images are
    never stored (BEVFormer's and VAD's encoders).
    """

    name = "fuse-operators"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Try every GridSample that is read, in the graph and its bodies."""
        nodes = nodes_in(model.graph)
        if not any(_is_sampler(node) or gathered.is_sampler(node) for node in nodes):
            return PassResult(model, 0)
        opset, unread = opset_of(model), remove_dead(model.graph)
        names, proofs = value_names(model.graph), Proofs(opset, context.seed)
        run = _Run(self.name, opset, names, proofs)
        left: list[str] = []
        for body in graphs_of(model.graph):
            left += run.try_nodes(body, gathered.is_sampler, run.sample)
            left += run.try_nodes(body, _is_sampler, run.fuse)
        if run.fused:
            model.opset_imports.setdefault(OWN_DOMAIN, 1)
        if run.fused or run.sampled:
            remove_dead(model.graph)
        fused = (
            f"fused: {run.fused} deformable attentions of {run.samplers} GridSample,"
            f" {run.worst:.1g} apart at most",
        )
        sampled = (f"written as GridSample: {run.sampled} samplings by Gather",)
        swept = (f"removed: {unread} unread",) * bool(unread)
        notes = (*fused * bool(run.fused), *sampled * bool(run.sampled), *left, *swept)
        return PassResult(model, run.fused + run.sampled + unread, notes)


def _is_sampler(node: ir.Node) -> bool:
    return node.op_type == "GridSample" and is_standard(node)


class _Run:
    """Rewrites matches, counts them, and keeps the largest error."""

    def __init__(self, by: str, opset: int, names: set[str], proofs: Proofs) -> None:
        self.by, self.opset, self.names, self.proofs = by, opset, names, proofs
        self.fused = self.samplers = self.sampled = 0
        self.worst = 0.0
        self._failed: set[tuple[ir.Value, ...]] = set()

    def try_nodes(
        self,
        body: ir.Graph,
        is_one: Callable[[ir.Node], bool],
        rewrite: Callable[[ir.Graph, ir.Node], None],
    ) -> Iterator[str]:
        """Rewrite every node of a kind; yield a note for each that stays."""
        for node in list(body):
            if node.graph is not body or not is_one(node):
                continue
            try:
                rewrite(body, node)
            except (PreconditionError, GraphError) as error:
                yield f"left {node.name}: {error}"

    def fuse(self, body: ir.Graph, node: ir.Node) -> None:
        """Fuse the attention of a GridSample."""
        match, plan = decomposed.find(node), None
        # With the following sum over images, if that can be included
        with contextlib.suppress(PreconditionError):
            plan = fused_form.plan(decomposed.with_images(match))
        plan = fused_form.plan(match) if plan is None else plan
        inputs = [view.value for view in plan.inputs]
        write = functools.partial(fused_form.write, plan)
        draw = functools.partial(draw_views, plan.inputs)
        error = self._replace(body, plan.result.value, inputs, write, draw)
        self.worst = max(self.worst, error)
        self.fused += 1
        self.samplers += len(match.levels)

    def sample(self, body: ir.Graph, node: ir.Node) -> None:
        """Write the sampling that a Gather is part of as GridSample."""
        floors = gathered.floors_of(node)
        if floors in self._failed:  # a corner of one that stays
            return
        self._failed.add(floors)
        reason: Exception = PreconditionError("it is not a sum of four corners")
        for guess in gathered.guesses(node, self.opset):
            inputs = [view.value for view in (guess.image, *guess.at)]
            sampling = guess.result.value, inputs, guess.write, guess.draw
            try:
                self._replace(body, *sampling, least=guess.draws)
            except (PreconditionError, GraphError) as error:
                reason = error.with_traceback(None)  # no circle of frames
                continue
            self._failed.remove(floors)
            self.sampled += 1
            return
        raise reason

    def _replace(
        self,
        body: ir.Graph,
        old: ir.Value,
        inputs: Sequence[ir.Value],
        write: Callable[[FusedCall], ir.Value],
        draw: Draw,
        least: int = 1,
    ) -> float:
        """Write a replacement of a value and keep it if it is proven; return its error.

        Raises:
            PreconditionError: both differ, or cannot be compared.
        """
        root, known = old.producer(), set(body.initializers)
        if root is None:
            raise PreconditionError(f"nothing makes {old.name}")
        matched = nodes_between(old, inputs)
        # Write the new nodes next to the old ones
        call = FusedCall(root, opset=self.opset, by=self.by, names=self.names)
        new = write(call)
        made = nodes_between(new, inputs)
        # Keep them only if both compute the same
        try:
            error = self.proofs.error(old, new, draw, least)
            if not error <= TOLERANCE:
                raise PreconditionError(
                    f"as one node it differs by {error:.1e} (allowed {TOLERANCE:.0e})"
                )
        except (PreconditionError, GraphError):
            take_back(body, made, known)
            raise
        for new_node in made:
            inherit(new_node, [root, *matched], by=self.by)
        replace_value(old, new)
        # Remove what is unread now, readers first
        for node in reversed(matched):
            if node.graph is not None and not any(map(is_read, node.outputs)):
                node.graph.remove(node, safe=True)
        return error
