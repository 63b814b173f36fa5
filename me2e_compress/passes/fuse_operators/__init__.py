"""Fuse decomposed operators into the fused operators of the toolkit."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import GraphError, PreconditionError
from me2e_compress.graph import array_of, digest, graphs_of, is_standard, opset_of
from me2e_compress.graph.nodes import Array, is_read, nodes_in
from me2e_compress.graph.provenance import inherit
from me2e_compress.graph.rewrite import remove_dead, replace_value, value_names
from me2e_compress.operators import OWN_DOMAIN, FusedCall, expand
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.digits import flat, sizes
from me2e_compress.passes.fuse_operators import decomposed, fused_form, gathered
from me2e_compress.passes.fuse_operators.views import View
from me2e_compress.runtime.session import Session

__all__ = ["FuseOperators"]

# Largest difference, relative to the largest result: the cost of summing float32 in
# another order, and of rounding positions on the way to -1..1 and back.
TOLERANCE = 1e-4

# How far beyond a feature map's edges positions are drawn, relative to its size.
OUTSIDE = 0.25

# The IR version of pieces: that of the first onnxruntime with GridSample.
IR_VERSION = 8

# Number of draws until a result is not zero: a single position lies outside the
# feature map in a third of all draws.
DRAWS = 8


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
        # Samplings by Gather become GridSample first, then both are fused
        opset, unread = opset_of(model), remove_dead(model.graph)
        names, proofs = value_names(model.graph), _Proofs(opset, context.seed)
        run = _Run(self.name, opset, names, proofs)
        rejected: list[str] = []
        for body in graphs_of(model.graph):
            rejected += run.try_nodes(body, gathered.is_sampler, run.sample)
            rejected += run.try_nodes(body, _is_sampler, run.fuse)
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
        notes = (
            *fused * bool(run.fused),
            *sampled * bool(run.sampled),
            *rejected,
            *swept,
        )
        return PassResult(model, run.fused + run.sampled + unread, notes)


def _is_sampler(node: ir.Node) -> bool:
    return node.op_type == "GridSample" and is_standard(node)


# Draws the inputs of two pieces of a graph.
_Draw: TypeAlias = Callable[[np.random.Generator], Mapping[ir.Value, Array]]


class _Run:
    """Rewrites matches, counts them, and keeps the largest error."""

    def __init__(self, by: str, opset: int, names: set[str], proofs: "_Proofs") -> None:
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
        draw = functools.partial(_draw_views, plan.inputs)
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
        # The first guess that is proven counts
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
        draw: _Draw,
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
            # Take the new nodes and weights back
            body.remove(reversed(made), safe=True)
            for name in [name for name in body.initializers if name not in known]:
                del body.initializers[name]
            raise
        for new_node in made:
            inherit(new_node, [root, *matched], by=self.by)
        replace_value(old, new)
        # Remove what is unread now, readers first
        for node in reversed(matched):
            if node.graph is not None and not any(map(is_read, node.outputs)):
                node.graph.remove(node, safe=True)
        return error


# Compare matched nodes with the fused node's body on random numbers.


def nodes_between(output: ir.Value, inputs: Sequence[ir.Value]) -> list[ir.Node]:
    """Return the nodes that compute a value from others and constants, in order."""
    # Depth first: a node is listed after all that it reads
    known: dict[ir.Node, None] = {}
    stops, stack = set(inputs), [(output.producer(), False)]
    while stack:
        node, done = stack.pop()
        if node is None or node in known:
            continue
        if done:
            known[node] = None
            continue
        stack.append((node, True))
        stack.extend(
            (value.producer(), False)
            for value in reversed(node.inputs)
            if value is not None and value not in stops
        )
    return list(known)


def piece_of(output: ir.Value, inputs: Sequence[ir.Value], opset: int) -> ir.Model:
    """Copy the nodes between values as a model of its own, with numbered names."""
    # What else the nodes read must be constant
    nodes = nodes_between(output, inputs)
    known = {*inputs, *(value for node in nodes for value in node.outputs)}
    read = dict.fromkeys(value for node in nodes for value in node.inputs if value)
    weights = [value for value in read if value not in known]
    for value in weights:
        if array_of(value) is None:
            raise PreconditionError(f"it reads {value.name} besides")
    imports = {"": opset, OWN_DOMAIN: 1}
    body = ir.GraphView(
        inputs, [output], nodes=nodes, initializers=weights, opset_imports=imports
    ).clone()
    # Equal pieces have equal names
    made = (value for node in body for value in node.outputs)
    values = [*body.inputs, *body.initializers.values(), *made]
    for index, value in enumerate(values):
        value.name = f"piece{index}"
    for index, node in enumerate(body):
        node.name = f"node{index}"
        node.metadata_props.clear()
    return ir.Model(body, ir_version=IR_VERSION)


def run_piece(piece: ir.Model, feeds: Sequence[Array]) -> Array:
    """Run a piece of a graph; fused nodes are replaced by their bodies."""
    for node in list(piece.graph):
        if node.domain == OWN_DOMAIN:
            expand(node, opset=opset_of(piece), by="check")
    names = (str(value.name) for value in piece.graph.inputs)
    named = dict(zip(names, feeds, strict=True))
    (result,) = Session(piece, optimize=False).run(named).values()
    return result


class _Proofs:
    """Compares pieces of a graph on fresh random numbers, and caches equal pairs."""

    def __init__(self, opset: int, seed: int) -> None:
        self._opset, self._seed = opset, seed
        self._known: dict[tuple[str, str], float] = {}

    def error(
        self, before: ir.Value, after: ir.Value, draw: _Draw, least: int = 1
    ) -> float:
        """Return max|a-b|/max|a| of two values that are computed from drawn inputs.

        At least ``least`` draws are compared, more while nothing but zeros comes out.

        Raises:
            PreconditionError: one of them reads another value too, or returns only
                zeros.
            GraphError: onnxruntime cannot run it.
        """
        # Equal pieces were compared before
        random = np.random.default_rng(self._seed)
        drawn, apart, largest = draw(random), 0.0, 0.0
        pieces = [piece_of(value, [*drawn], self._opset) for value in (before, after)]
        key = (digest(pieces[0]), digest(pieces[1]))
        if key in self._known:
            return self._known[key]
        # Draw until enough results are not zero
        for count in range(1, DRAWS + least):
            feeds = list(drawn.values())
            a, b = (run_piece(piece, feeds).astype(np.float64) for piece in pieces)
            apart = max(apart, float(np.abs(a - b).max()))
            largest = max(largest, float(np.abs(a).max()))
            if largest and count >= least:
                self._known[key] = apart / largest
                return self._known[key]
            drawn = draw(random)
        raise PreconditionError("nothing but zeros comes out of random numbers")


def _draw_views(
    views: Sequence[View], random: np.random.Generator
) -> dict[ir.Value, Array]:
    """Draw normal numbers; a third of the positions lie outside the feature maps."""
    drawn: dict[ir.Value, Array] = {}
    for view in views:
        shape = sizes(view.layout)
        if any(digit.axis == decomposed.XY for digit in flat(view.layout)):
            places = random.uniform(-1 - 2 * OUTSIDE, 1 + 2 * OUTSIDE, shape)
            array = (places - view.shift) / view.scale
        else:
            array = random.standard_normal(shape)
        kind = view.value.dtype or ir.DataType.FLOAT
        drawn[view.value] = array.astype(kind.numpy())
    return drawn
