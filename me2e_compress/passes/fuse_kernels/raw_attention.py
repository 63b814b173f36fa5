"""Fuse positions and weights into the deformable attention that reads them."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import array_of, static_shape
from me2e_compress.graph.nodes import sole_maker
from me2e_compress.graph.rewrite.raise_opset import OLDEST_OPSET
from me2e_compress.operators import OWN_DOMAIN, FusedCall
from me2e_compress.operators.deformable_attention import RAW_ATTENTION
from me2e_compress.passes.digits import Digit, Layout, flat, merged, whole
from me2e_compress.passes.digits import sizes as sizes_of
from me2e_compress.passes.fuse_operators.fused_form import (
    combined,
    cost_of,
    laid_out,
    whole_views,
)
from me2e_compress.passes.fuse_operators.views import View, operands, sources

# Points of a level: with one, the kernel takes up to 1.4 times as long as the nodes,
# with two 0.7 to 1.2 (one core of an AMD EPYC, Zen 4; `benchmarks.measure.fusions`)
LEAST_POINTS = 2

BATCH, QUERY, HEAD, LEVEL, POINT = "batch", "query", "head", "level", "point"
# The axes of locations, which are in 0..1: not the ``xy`` of a grid's in -1..1.
XY = "x, y"


@dataclasses.dataclass(frozen=True)
class _Sizes:
    """N, Q, M, L and P of a call."""

    batch: int
    queries: int
    heads: int
    levels: int
    points: int

    @property
    def weights(self) -> Layout:
        """The layout of attention weights."""
        axes = (BATCH, QUERY, HEAD, LEVEL, POINT)
        return tuple(map(whole, axes, dataclasses.astuple(self)))

    def form(self, views: Sequence[View], *, of_camera: bool = True) -> Layout:
        """Return the smallest layout of an operand that has the digits of views.

        It lacks batch, queries or heads as a whole, and repeats over points. Levels are
        the outer ones ``of_camera``, else inner ones that repeat.
        """
        digits = [digit for view in views for digit in flat(view.layout)]

        def ends(axis: str) -> int:
            return max((d.end for d in digits if d.axis == axis), default=1)

        # Batch, queries and heads are there as a whole, or not at all
        outer = (
            full if ends(axis) > 1 else ()
            for axis, full in zip((BATCH, QUERY, HEAD), self.weights, strict=False)
        )
        # Levels of one camera are the inner digits, cameras the outer
        strides = [digit.stride for digit in digits if digit.axis == LEVEL]
        least = min(strides, default=self.levels)
        levels = whole(LEVEL, ends(LEVEL))
        if of_camera:
            count = self.levels // least
            levels = (Digit(LEVEL, least, count),) if count > 1 else ()
        return (*outer, levels, whole(POINT, ends(POINT)))


@dataclasses.dataclass(frozen=True)
class _Match:
    """Where the operands of a call are read; None for one that it lacks.

    ``rows`` is the layout of the scores, whose last dimension is a row of the softmax.
    """

    sizes: _Sizes
    near: View | None
    away: View
    scores: View | None
    rows: Layout
    masks: tuple[View, ...]
    scale: float


def fuse_raw_attention(node: ir.Node, call: FusedCall) -> ir.Value | None:
    """Fuse the sum of reference points and offsets, and the softmax and its mask.

    Given:   y = me2e::MultiScaleDeformableAttention(
                 value, sizes, starts, points + offsets, Softmax(scores) * mask)

    Result:  y = me2e::RawDeformableAttention(
                 value, sizes, starts, points, offsets, scores, mask)

    Operands are read before they are repeated. An operand that is no such sum or
    softmax, or that other nodes read too, stays as it is.
    """
    form = _match(node) if call.opset >= OLDEST_OPSET else None
    if form is None:
        return None
    inputs = [*node.inputs[:3], *_written(call, form)]
    result = call.add(RAW_ATTENTION, inputs, domain=OWN_DOMAIN)
    result.shape, result.type = node.outputs[0].shape, node.outputs[0].type
    return result


def _match(node: ir.Node) -> _Match | None:
    locations, weights = node.inputs[3], node.inputs[4]
    shape = static_shape(locations)
    if locations is None or weights is None or shape is None:
        raise PreconditionError("the shape of its locations is unknown")
    if shape[:5] != static_shape(weights):
        raise PreconditionError("its weights have another shape than its locations")
    sizes = _Sizes(*shape[:5])
    if sizes.points < LEAST_POINTS:
        raise PreconditionError("its nodes are as fast: one point for each level")
    at = View(locations, (*sizes.weights, whole(XY, 2)))
    share = View(weights, sizes.weights)
    plain = _Match(sizes, None, at, None, ((),) * 5, (share,), 1.0)
    # The sum and the softmax, if they are there
    form = _product(share, plain) or plain
    places = _sum(at)
    if places is not None:
        form = dataclasses.replace(form, near=places[0], away=places[1])
    if form == plain:
        return None
    # Every operand is read where that moves the least data
    near, scores = form.near, form.scores
    return dataclasses.replace(
        form,
        near=near and _cheapest(near, lambda v: _pairs(sizes.form([v]))),
        away=_cheapest(form.away, lambda v: _away(sizes, v)),
        scores=scores and _cheapest(scores, lambda v: form.rows),
        masks=tuple(_cheapest(mask, lambda v: sizes.form([v])) for mask in form.masks),
    )


def _cheapest(view: View, form: Callable[[View], Layout]) -> View:
    def cost(source: View) -> float:
        return cost_of(source, form(source)) + 4 * math.prod(sizes_of(form(source)))

    best = min(reversed(whole_views(view)), key=cost)
    if math.isinf(cost(best)):
        raise PreconditionError(f"{view.value.name} repeats in another order")
    return best


def _pairs(layout: Layout) -> Layout:
    return (*layout, whole(XY, 2))


def _away(sizes: _Sizes, view: View) -> Layout:
    """Return the layout of offsets, which may lack levels only."""
    *outer, _, points = sizes.weights
    return _pairs((*outer, sizes.form([view], of_camera=False)[3], points))


def _written(call: FusedCall, read: _Match) -> list[ir.Value]:
    """Write the operands from reference points to mask."""
    zeros, like, form = np.zeros((1, 1, 1, 1, 1, 2)), read.away.value, read.sizes.form
    # Zeros stand for no reference point, and for weights without a softmax
    near = call.numbers(zeros, like)
    if read.near is not None:
        near = laid_out(call, read.near, _pairs(form([read.near])))
    away = laid_out(call, read.away, _away(read.sizes, read.away))
    scores = call.numbers(zeros[..., 0], like)
    if read.scores is not None:
        scores = laid_out(call, read.scores, read.rows)
    mask = call.numbers(np.full((1, 1, 1, 1, 1), read.scale), like)
    if read.masks:
        product = combined(call, "Mul", read.masks, form(read.masks))
        mask = product if read.scale == 1.0 else call.add("Mul", [product, mask])
    return [near, away, scores, mask]


def _sum(view: View) -> tuple[View, View] | None:
    """Return reference points and offsets, if a value is their sum and nothing else."""
    parts = operands(whole_views(view)[-1], "Add")
    if parts is None:
        return None
    near, away = sorted(parts, key=lambda part: math.prod(sizes_of(part.layout)))
    needed = _axes(view) - {BATCH, LEVEL}
    if not needed <= _axes(away):
        near, away = away, near
    # A bias is no reference point: it stays with its product
    bias = array_of(near.value) is not None and QUERY not in _axes(near)
    return None if bias or not needed <= _axes(away) else (near, away)


def _axes(view: View) -> set[str]:
    return {digit.axis for digit in flat(view.layout)}


def _product(view: View, plain: _Match) -> _Match | None:
    """Return the factors of weights, if one of them is a softmax over points."""
    # Walk back to where the weights are made: a Softmax, or a Mul of factors
    *_, last = (source for source in sources(view) if isinstance(source, View))
    if last.shift != 0.0:
        return None
    node = sole_maker(last.value, "Softmax")
    if node is not None:
        return _softmax(node, last, plain)
    # One factor is the softmax, perhaps behind other products
    factors = operands(View(last.value, last.layout), "Mul") or ()
    for one, other in itertools.permutations(factors, 2):
        inner = _product(one, plain)
        if inner is not None:
            masks, scale = (*inner.masks, other), inner.scale * last.scale
            return dataclasses.replace(inner, masks=masks, scale=scale)
    return None


def _softmax(node: ir.Node, view: View, plain: _Match) -> _Match | None:
    """Return the scores of a softmax over the points of one level or of several."""
    source = node.inputs[0]
    assert source is not None
    row = merged(view.layout[node.attributes.get_int("axis", -1)])
    levels = math.prod(digit.size for digit in row if digit.axis == LEVEL)
    if row != (*whole(LEVEL, levels), *whole(POINT, plain.sizes.points)):
        return None
    # Rows that differ by level stand beside each other
    *outer, repeated, _ = plain.sizes.form([view], of_camera=False)
    others = math.prod(digit.size for digit in repeated) // levels
    beside = (Digit(LEVEL, levels, others),) if others > 1 else ()
    scores = View(source, view.layout)
    rows, scale = (*outer, beside, row), view.scale
    return dataclasses.replace(plain, scores=scores, rows=rows, masks=(), scale=scale)
