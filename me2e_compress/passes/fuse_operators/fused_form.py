"""The fused node in the place of a deformable attention: its operands laid out."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.operators import OWN_DOMAIN, FusedCall
from me2e_compress.passes.fuse_operators.decomposed import (
    BATCH,
    CHANNEL,
    LEVEL,
    PIXEL,
    XY,
    Decomposed,
)
from me2e_compress.passes.fuse_operators.digits import (
    Digit,
    Layout,
    flat,
    merged,
    runs,
    sizes,
    split_like,
    whole,
)
from me2e_compress.passes.fuse_operators.views import (
    Selection,
    View,
    joined,
    sources,
)

OP_TYPE = "MultiScaleDeformableAttention"

Source = tuple[View, ...]
"""Where an operand comes from: one view of all levels, or one of every level."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """How a deformable attention becomes one node.

    Attributes:
        found: what it was.
        heads: how many the batch is split into.
        value: where the feature maps come from.
        locations: where the positions come from.
        weights: where the weights come from.
        result: what is replaced.
    """

    found: Decomposed
    heads: int
    value: Source
    locations: Source
    weights: Source
    result: View

    @property
    def inputs(self) -> tuple[View, ...]:
        """Every view that the fused node is fed from."""
        return (*self.value, *self.locations, *self.weights)


def plan(found: Decomposed) -> Plan:
    """Choose where to read and what to replace, so that the least data is moved."""
    value = _options([level.image for level in found.levels], _pixels)
    locations = _options([level.grid for level in found.levels], _levels)
    weights = _options([found.weights], _levels)
    views = [view for option in (*value, *locations, *weights) for view in option]
    plans = []
    for heads in _head_counts(found, [*views, *found.results]):
        form = _Form(found, heads)
        chosen = (
            _cheapest(value, form.value),
            _cheapest(locations, form.locations),
            _cheapest(weights, form.weights),
        )
        # of the results, the one furthest behind takes the most with it
        last = min(reversed(found.results), key=lambda view: form.result_cost(view))
        cost = sum(each[0] for each in chosen) + form.result_cost(last)
        read = [option for _, option in chosen]
        plans.append((cost, Plan(found, heads, read[0], read[1], read[2], last)))
    return min(plans, key=lambda each: each[0])[1]


def write(chosen: Plan, call: FusedCall) -> ir.Value:
    """Write the fused node and what lays out its operands; return what it gives.

    Args:
        chosen: how.
        call: where: in front of the node that makes what is replaced.
    """
    form = _Form(chosen.found, chosen.heads)
    shapes = np.array([level.size for level in chosen.found.levels], np.int64)
    starts = np.cumsum([0, *(each.pixels for each in chosen.found.levels[:-1])])
    made = call.add(
        OP_TYPE,
        [
            _operand(call, chosen.value, form.value, 1),
            call.constant(shapes, "spatial_shapes"),
            call.constant(starts.astype(np.int64), "level_start_index"),
            _operand(call, chosen.locations, form.locations, 3),
            _operand(call, chosen.weights, form.weights, 3),
        ],
        domain=OWN_DOMAIN,
    )
    made.dtype = ir.DataType.FLOAT
    made.shape = ir.Shape(sizes(form.result))
    return _laid_out(call, View(made, form.result), chosen.result.layout)


@dataclasses.dataclass(frozen=True)
class _Form:
    """The layouts of the fused node's operands, for a number of heads."""

    found: Decomposed
    heads: int

    def value(self, level: int | None) -> Layout:
        levels = self.found.levels
        total = sum(each.pixels for each in levels)
        pixels = total if level is None else levels[level].pixels
        return (*self._outer(whole(PIXEL, pixels)), whole(CHANNEL, self.found.channels))

    def locations(self, level: int | None) -> Layout:
        return (*self.weights(level), whole(XY, 2))

    def weights(self, level: int | None) -> Layout:
        levels = len(self.found.levels) if level is None else 1
        outer = self._outer(self.found.queries)
        return (*outer, whole(LEVEL, levels), self.found.points)

    @property
    def result(self) -> Layout:
        outer = self._outer(self.found.queries)
        return (*outer, whole(CHANNEL, self.found.channels))

    def result_cost(self, view: View) -> float:
        return _cost(View(view.value, self.result), view.layout)

    def _outer(self, middle: tuple[Digit, ...]) -> Layout:
        images = self.found.batch // self.heads
        batch = (Digit(BATCH, self.heads, images),) if images > 1 else ()
        return (batch, middle, whole(BATCH, self.heads))


def _pixels(selections: Sequence[Selection]) -> View | None:
    """Join feature maps that were cut from one row of pixels, level after level."""
    for each in selections:
        digits = merged(each.view.layout[each.axis])
        if digits != whole(PIXEL, each.size):
            return None
    return joined(selections, whole(PIXEL, sum(each.size for each in selections)))


def _levels(selections: Sequence[Selection]) -> View | None:
    """Join positions that were cut from one row of levels."""
    first = selections[0]
    digits = first.view.layout[first.axis]
    if any(each.view.layout[each.axis] != digits for each in selections):
        return None
    return joined(selections, (*whole(LEVEL, len(selections)), *digits))


def _options(
    views: Sequence[View], join: Callable[[Sequence[Selection]], View | None]
) -> list[Source]:
    """List where an operand may be read: of every level, then of all together."""
    walks = [list(sources(view)) for view in views]
    ends = [walk[-1] for walk in walks]
    options: list[Source] = list(
        zip(
            *([each for each in walk if isinstance(each, View)] for walk in walks),
            strict=False,  # a level may be read from further away than another
        )
    )
    selections = [each for each in ends if isinstance(each, Selection)]
    if len(selections) < len(ends):
        return options
    first = selections[0]
    together = (
        joined(selections, first.view.layout[first.axis])
        if len(selections) == 1
        else join(selections)
    )
    return options if together is None else [*options, *_options([together], join)]


def _head_counts(found: Decomposed, views: Sequence[View]) -> list[int]:
    """List the numbers of heads that the layouts suggest, the most first."""
    counts = {1, found.batch}
    for view in views:
        for digit in flat(view.layout):
            if digit.axis == BATCH:
                counts |= {digit.stride, digit.end}
    return sorted(counts, reverse=True)


def _cheapest(
    options: Sequence[Source], form: Callable[[int | None], Layout]
) -> tuple[float, Source]:
    """Return the source that costs least to lay out; of equals the last one."""

    def cost(option: Source) -> float:
        if len(option) == 1:
            return _cost(option[0], form(None))
        joint = sum(_bytes(view) for view in option)
        parts = (_cost(view, form(level)) for level, view in enumerate(option))
        return joint + sum(parts)

    best = min(reversed(options), key=cost)
    return cost(best), best


def _bytes(view: View) -> float:
    return 4.0 * math.prod(sizes(view.layout))


def _cost(view: View, form: Layout) -> float:
    """Count the bytes that are written to lay a view out."""
    have, wanted = flat(view.layout), flat(form)
    have, wanted = split_like(have, wanted), split_like(wanted, have)
    present = tuple(digit for digit in wanted if digit in have)
    if set(have) - set(present):
        return math.inf
    steps = int(present != have) + 2 * int(_moved(view) != (1.0, 0.0))
    repeated = 4.0 * math.prod(sizes(form)) if len(present) < len(wanted) else 0.0
    return steps * _bytes(view) + repeated


def _moved(view: View) -> tuple[float, float]:
    """Return what a view's elements are multiplied by, and what is added then.

    A grid's are taken from -1..1, between the outer edges, to 0..1.
    """
    if not any(digit.axis == XY for digit in flat(view.layout)):
        return view.scale, view.shift
    return view.scale / 2, (view.shift + 1) / 2


def _operand(
    call: FusedCall, source: Source, form: Callable[[int | None], Layout], axis: int
) -> ir.Value:
    if len(source) == 1:
        return _laid_out(call, source[0], form(None))
    parts = [_laid_out(call, view, form(level)) for level, view in enumerate(source)]
    return call.concat(parts, axis)


def _laid_out(call: FusedCall, view: View, form: Layout) -> ir.Value:
    """Write the operators that take a view to a layout; none where it has it."""
    value = view.value
    scale, shift = _moved(view)
    if scale != 1.0:
        value = call.add("Mul", [value, call.numbers(scale, value)])
    if shift != 0.0:
        value = call.add("Add", [value, call.numbers(shift, value)])
    have, wanted = flat(view.layout), flat(form)
    have, wanted = split_like(have, wanted), split_like(wanted, have)
    present = tuple(digit for digit in wanted if digit in have)
    shape = sizes(view.layout)
    if present != have:
        pieces, order = runs(have, present)
        value = call.transpose(_shaped(call, value, shape, sizes(tuple(pieces))), order)
        shape = tuple(sizes(tuple(pieces))[place] for place in order)
    if len(present) < len(wanted):
        ones = [digit.size if digit in have else 1 for digit in wanted]
        full = [digit.size for digit in wanted]
        value = _shaped(call, value, shape, ones)
        value, shape = call.add("Expand", [value, call.integers(full)]), tuple(full)
    return _shaped(call, value, shape, sizes(form))


def _shaped(
    call: FusedCall, value: ir.Value, have: Sequence[int], wanted: Sequence[int]
) -> ir.Value:
    return value if tuple(have) == tuple(wanted) else call.reshape(value, list(wanted))
