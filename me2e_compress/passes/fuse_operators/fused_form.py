"""Write the fused node of a deformable attention and lay out its operands."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Container, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.operators import OWN_DOMAIN, FusedCall
from me2e_compress.passes.digits import (
    Digit,
    Digits,
    Layout,
    flat,
    merged,
    runs,
    sizes,
    split_like,
    whole,
)
from me2e_compress.passes.fuse_operators.decomposed import (
    BATCH,
    CHANNEL,
    LEVEL,
    PIXEL,
    XY,
    Decomposed,
)
from me2e_compress.passes.fuse_operators.views import (
    Selection,
    View,
    joined,
    operands,
    sources,
)


@dataclasses.dataclass(frozen=True)
class Source:
    """The views of an operand: one, or one per level, or the two terms of a sum."""

    views: tuple[View, ...]
    total: bool = False


def join_pixels(selections: Sequence[Selection]) -> View | None:
    """Join feature maps that were cut from one row of pixels, level after level."""
    if any(
        merged(selection.view.layout[selection.axis]) != whole(PIXEL, selection.size)
        for selection in selections
    ):
        return None
    return joined(
        selections, whole(PIXEL, sum(selection.size for selection in selections))
    )


def join_levels(selections: Sequence[Selection]) -> View | None:
    """Join positions that were cut from one row of levels."""
    first = selections[0]
    digits = first.view.layout[first.axis]
    if any(selection.view.layout[selection.axis] != digits for selection in selections):
        return None
    return joined(selections, (*whole(LEVEL, len(selections)), *digits))


def options_of(
    views: Sequence[View], join: Callable[[Sequence[Selection]], View | None]
) -> list[Source]:
    """Return where an operand can be read: level by level, then all levels at once."""
    # Walk back from each level; one may be read from further away than another
    walks = [list(sources(view)) for view in views]
    steps = ([view for view in walk if isinstance(view, View)] for walk in walks)
    options = [Source(option) for option in zip(*steps, strict=False)]
    # Where all levels are selections of one value, read that
    selections = [walk[-1] for walk in walks if isinstance(walk[-1], Selection)]
    if len(selections) < len(walks):
        return options
    first = selections[0]
    together = (
        joined(selections, first.view.layout[first.axis])
        if len(selections) == 1
        else join(selections)
    )
    return options if together is None else [*options, *options_of([together], join)]


def whole_views(view: View) -> list[View]:
    """Return where a value can be read as a whole and unscaled."""
    views = (source for source in sources(view) if isinstance(source, View))
    scaling = view.scale, view.shift
    return [v for v in views if (v.scale, v.shift) == scaling]


def sums_of(option: Source) -> list[Source]:
    """Return where the two terms of an operand can be read, if it is an unscaled sum.

    Positions are often the sum of few reference points and offsets, cheaper to move.
    """
    if len(option.views) != 1 or scaling(option.views[0]) != (1.0, 0.0):
        return []
    parts = operands(option.views[0], "Add")
    if parts is None:
        return []
    first, second = (
        [v for v in sources(part) if isinstance(v, View) and v.shift == part.shift]
        for part in parts
    )
    return [Source((a, b), total=True) for a in first for b in second]


def cheapest(
    options: Sequence[Source],
    form: Callable[[int | None], Layout],
    covered: Digits = (),
) -> tuple[float, Source]:
    """Return the lowest cost of laying out a source, and the last such source.

    ``covered`` are digits over which a later product repeats the operand anyway.
    """

    def cost(option: Source) -> float:
        if option.total:
            return sum(cost_of(v, form(None), part=True) for v in option.views)
        if len(option.views) == 1:
            return cost_of(option.views[0], form(None), covered=covered)
        joint = sum(_bytes(view) for view in option.views)
        return joint + sum(cost_of(v, form(i)) for i, v in enumerate(option.views))

    best = min(reversed(options), key=cost)
    return cost(best), best


def _bytes(view: View) -> float:
    return 4.0 * math.prod(sizes(view.layout))


def cost_of(
    view: View, form: Layout, *, covered: tuple[Digit, ...] = (), part: bool = False
) -> float:
    """Return the bytes written to bring a view to a layout.

    It need not be repeated over ``covered`` digits. A ``part`` of a sum or product is
    repeated by that, and scaled elsewhere.
    """
    have, wanted = flat(view.layout), flat(form)
    have, wanted = split_like(have, wanted), split_like(wanted, have)
    present = tuple(digit for digit in wanted if digit in have)
    if set(have) - set(present):
        return math.inf
    scaled = not part and scaling(view) != (1.0, 0.0)
    steps = int(present != have) + 2 * int(scaled)
    lacking = set(wanted) - set(have) - set(split_like(covered, wanted))
    more = 4.0 * math.prod(sizes(form)) if lacking and not part else 0.0
    return steps * _bytes(view) + more


def scaling(view: View) -> tuple[float, float]:
    """Return the factor and then the summand of a view's elements.

    Those of a grid are taken from -1..1, between the outer edges, to 0..1.
    """
    if not any(digit.axis == XY for digit in flat(view.layout)):
        return view.scale, view.shift
    return view.scale / 2, (view.shift + 1) / 2


# Write the operators that bring views of values to the layout of an operand.


def laid_out(call: FusedCall, view: View, form: Layout) -> ir.Value:
    """Write the operators from a view to a layout, repeating over missing digits."""
    value, (scale, shift) = view.value, scaling(view)
    if scale != 1.0:
        value = call.add("Mul", [value, call.numbers(scale, value)])
    if shift != 0.0:
        value = call.add("Add", [value, call.numbers(shift, value)])
    # Split digits on both sides so that they match
    have, wanted = flat(view.layout), flat(form)
    have, wanted = split_like(have, wanted), split_like(wanted, have)
    present = tuple(digit for digit in wanted if digit in have)
    if present != have:
        # Reorder runs of digits by one Transpose
        pieces, order = runs(have, present)
        value = call.transpose(call.view(value, sizes(tuple(pieces))), order)
    if len(present) < len(wanted):
        return _repeated(call, value, wanted, have, form)
    return call.view(value, sizes(form))


def combined(
    call: FusedCall, op_type: str, views: Sequence[View], form: Layout
) -> ir.Value:
    """Write an Add or Mul of views in a layout, each repeated by broadcasting."""
    if len(views) == 1:
        return laid_out(call, views[0], form)
    # Split each dimension into runs that every view has or lacks as a whole
    digits = [digit for view in views for digit in flat(view.layout)]
    every = split_like(flat(form), digits)
    have = [set(split_like(flat(view.layout), every)) for view in views]
    groups: list[Digits] = []
    for dimension in form:
        split = split_like(dimension, digits)
        by_owners = itertools.groupby(split, lambda d: [d in own for own in have])
        groups.extend(tuple(run) for _, run in by_owners)
    # Combine the views by broadcasting
    value: ir.Value | None = None
    for view, mine in zip(views, have, strict=True):
        own = tuple(run if run[0] in mine else () for run in groups)
        part = laid_out(call, view, own)
        value = part if value is None else call.add(op_type, [value, part])
    assert value is not None
    # Expand along digits that no view has
    present = set().union(*have)
    shape = sizes(tuple(run if run[0] in present else () for run in groups))
    if shape == sizes(tuple(groups)):
        return call.view(value, sizes(form))
    return _repeated(call, value, flat(tuple(groups)), present, form)


def _repeated(
    call: FusedCall,
    value: ir.Value,
    wanted: Digits,
    present: Container[Digit],
    form: Layout,
) -> ir.Value:
    """Repeat a value of the present digits over all wanted ones, in a layout."""
    full = [digit.size for digit in wanted]
    ones = [digit.size if digit in present else 1 for digit in wanted]
    value = call.add("Expand", [call.view(value, ones), call.integers(full)])
    return call.view(value, sizes(form))


OP_TYPE = "MultiScaleDeformableAttention"


@dataclasses.dataclass(frozen=True)
class Plan:
    """How a deformable attention becomes one node; ``cost`` is in bytes of layouts."""

    decomposed: Decomposed
    heads: int
    value: Source
    locations: Source
    weights: Source
    mask: View | None
    result: View
    cost: float

    @property
    def inputs(self) -> tuple[View, ...]:
        """Every view that the fused node reads."""
        mask = () if self.mask is None else (self.mask,)
        return (*self.value.views, *self.locations.views, *self.weights.views, *mask)


def plan(decomposed: Decomposed) -> Plan:
    """Choose where to read and what to replace, so that the least data is moved.

    Images can be added up only if levels are contiguous, else PreconditionError.
    """
    # List where each operand can be read
    value = options_of([level.image for level in decomposed.levels], join_pixels)
    plain = options_of([level.grid for level in decomposed.levels], join_levels)
    # of equals the last one is taken: sums are the last resort
    locations = [*(source for option in plain for source in sums_of(option)), *plain]
    if decomposed.images:  # their levels lie image by image: there is nothing to join
        value = [option for option in value if len(option.views) == 1]
        locations = [
            option for option in locations if len(option.views) == 1 or option.total
        ]
        if not (value and locations):
            raise PreconditionError("its levels are made apart")
    weights = [Source((view,)) for view in whole_views(decomposed.weights)]
    masks = [] if decomposed.mask is None else whole_views(decomposed.mask)
    known = [view for source in (*value, *locations, *weights) for view in source.views]
    # Price every number of heads with the best source of each operand
    plans = []
    for heads in _head_counts(decomposed, [*known, *masks, *decomposed.results]):
        form = _Form(decomposed, heads)
        covered = flat(decomposed.mask.layout) if decomposed.mask is not None else ()
        read = cheapest(value, form.value)
        places = cheapest(locations, form.locations)
        shares = cheapest(weights, form.weights, covered)
        full = form.weights(None)
        costs = {view: cost_of(view, full, part=True) for view in reversed(masks)}
        mask = min(costs, key=costs.__getitem__, default=None)
        # Of results of equal cost, the last one replaces the most nodes
        last = min(reversed(decomposed.results), key=form.result_cost)
        cost = read[0] + places[0] + shares[0] + form.result_cost(last)
        plans.append(
            Plan(decomposed, heads, read[1], places[1], shares[1], mask, last, cost)
        )
    best = min(plans, key=lambda option: option.cost)
    if best.cost == math.inf:
        raise PreconditionError("its operands have no layout in common")
    return best


def write(chosen: Plan, call: FusedCall) -> ir.Value:
    """Write the fused node and its layouts before the old node; return its result."""
    decomposed = chosen.decomposed
    form = _Form(decomposed, chosen.heads)
    images = math.prod(digit.size for digit in decomposed.images)
    # Weights with their mask and scale; each image is one more set of levels
    shapes = np.array([level.size for level in decomposed.levels] * images, np.int64)
    areas = shapes.prod(axis=1)
    operands = [
        _operand(call, chosen.value, form.value, 1),
        call.constant(shapes, "spatial_shapes"),
        call.constant(np.cumsum(areas) - areas, "level_start_index"),
        _operand(call, chosen.locations, form.locations, 3),
    ]
    factors = [*chosen.weights.views, *([chosen.mask] if chosen.mask else [])]
    weights = combined(call, "Mul", factors, form.weights(None))
    if decomposed.scale != 1.0:
        weights = call.add("Mul", [weights, call.numbers(decomposed.scale, weights)])
    made = call.add(OP_TYPE, [*operands, weights], domain=OWN_DOMAIN)
    # Bring the result to the layout of the replaced value
    made.dtype = ir.DataType.FLOAT
    made.shape = ir.Shape(sizes(form.result))
    return laid_out(call, View(made, form.result), chosen.result.layout)


@dataclasses.dataclass(frozen=True)
class _Form:
    """The layouts of the fused node's operands, for a number of heads."""

    decomposed: Decomposed
    heads: int

    def value(self, level: int | None) -> Layout:
        levels = self.decomposed.levels
        total = sum(item.pixels for item in levels)
        pixels = whole(PIXEL, total if level is None else levels[level].pixels)
        outer = self._outer((*self.decomposed.images, *pixels))
        return (*outer, whole(CHANNEL, self.decomposed.channels))

    def locations(self, level: int | None) -> Layout:
        return (*self.weights(level), whole(XY, 2))

    def weights(self, level: int | None) -> Layout:
        levels = len(self.decomposed.levels) if level is None else 1
        outer = self._outer(self.decomposed.queries)
        both = (*self.decomposed.images, *whole(LEVEL, levels))
        return (*outer, both, self.decomposed.points)

    @property
    def result(self) -> Layout:
        outer = self._outer(self.decomposed.queries)
        return (*outer, whole(CHANNEL, self.decomposed.channels))

    def result_cost(self, view: View) -> float:
        return cost_of(View(view.value, self.result), view.layout)

    def _outer(self, middle: tuple[Digit, ...]) -> Layout:
        images = self.decomposed.batch // self.heads
        batch = (Digit(BATCH, self.heads, images),) if images > 1 else ()
        # Images that are added up become levels
        kept = split_like(batch, self.decomposed.images)
        kept = tuple(digit for digit in kept if digit not in self.decomposed.images)
        return (kept, middle, whole(BATCH, self.heads))


def _head_counts(decomposed: Decomposed, views: Sequence[View]) -> list[int]:
    """Return the numbers of heads that the layouts suggest, largest first."""
    counts = {1, decomposed.batch}
    for view in views:
        for digit in flat(view.layout):
            if digit.axis == BATCH:
                counts |= {digit.stride, digit.end}
    least = min((digit.stride for digit in decomposed.images), default=decomposed.batch)
    return sorted((count for count in counts if count <= least), reverse=True)


def _operand(
    call: FusedCall, source: Source, form: Callable[[int | None], Layout], axis: int
) -> ir.Value:
    if source.total:
        return combined(call, "Add", source.views, form(None))
    if len(source.views) == 1:
        return laid_out(call, source.views[0], form(None))
    parts = [laid_out(call, v, form(level)) for level, v in enumerate(source.views)]
    return call.concat(parts, axis)
