"""Write the fused node of a deformable attention and lay out its operands."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.errors import PreconditionError
from me2e_compress.operators import OWN_DOMAIN, FusedCall
from me2e_compress.passes.digits import Digit, Layout, flat, sizes, split_like, whole
from me2e_compress.passes.fuse_operators.decomposed import (
    BATCH,
    CHANNEL,
    LEVEL,
    PIXEL,
    XY,
    Decomposed,
)
from me2e_compress.passes.fuse_operators.laid_out import combined, laid_out
from me2e_compress.passes.fuse_operators.operand_sources import (
    Source,
    cheapest,
    cost_of,
    join_levels,
    join_pixels,
    options_of,
    sums_of,
    whole_views,
)
from me2e_compress.passes.fuse_operators.views import View

OP_TYPE = "MultiScaleDeformableAttention"


@dataclasses.dataclass(frozen=True)
class Plan:
    """How a deformable attention becomes one node; ``cost`` is in bytes of layouts."""

    found: Decomposed
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
        sources = (self.value, self.locations, self.weights)
        return (*(view for each in sources for view in each.views), *mask)


def plan(found: Decomposed) -> Plan:
    """Choose where to read and what to replace, so that the least data is moved.

    Images can be added up only if levels are contiguous, else PreconditionError.
    """
    # List where each operand can be read
    value = options_of([level.image for level in found.levels], join_pixels)
    plain = options_of([level.grid for level in found.levels], join_levels)
    # of equals the last one is taken: sums are the last resort
    locations = [*(each for option in plain for each in sums_of(option)), *plain]
    if found.images:  # their levels lie image by image: there is nothing to join
        value = [each for each in value if len(each.views) == 1]
        locations = [each for each in locations if len(each.views) == 1 or each.total]
        if not (value and locations):
            raise PreconditionError("its levels are made apart")
    weights = [Source((view,)) for view in whole_views(found.weights)]
    masks = [] if found.mask is None else whole_views(found.mask)
    known = [view for each in (*value, *locations, *weights) for view in each.views]
    # Price every number of heads with the best source of each operand
    plans = []
    for heads in _head_counts(found, [*known, *masks, *found.results]):
        form = _Form(found, heads)
        covered = flat(found.mask.layout) if found.mask is not None else ()
        read = cheapest(value, form.value)
        places = cheapest(locations, form.locations)
        shares = cheapest(weights, form.weights, covered)
        mask = min(
            reversed(masks),
            key=lambda view: cost_of(view, form.weights(None), part=True),
            default=None,
        )
        # of the results, the one furthest behind takes the most with it
        last = min(reversed(found.results), key=lambda view: form.result_cost(view))
        cost = read[0] + places[0] + shares[0] + form.result_cost(last)
        plans.append(
            Plan(found, heads, read[1], places[1], shares[1], mask, last, cost)
        )
    best = min(plans, key=lambda each: each.cost)
    if best.cost == math.inf:
        raise PreconditionError("its operands have no layout in common")
    return best


def write(chosen: Plan, call: FusedCall) -> ir.Value:
    """Write the fused node and its layouts before the old node; return its result."""
    found = chosen.found
    form = _Form(found, chosen.heads)
    images = math.prod(digit.size for digit in found.images)
    # Each image is one more set of levels
    shapes = np.array([level.size for level in found.levels] * images, np.int64)
    areas = shapes.prod(axis=1)
    made = call.add(
        OP_TYPE,
        [
            _operand(call, chosen.value, form.value, 1),
            call.constant(shapes, "spatial_shapes"),
            call.constant(np.cumsum(areas) - areas, "level_start_index"),
            _operand(call, chosen.locations, form.locations, 3),
            _weights(call, chosen, form),
        ],
        domain=OWN_DOMAIN,
    )
    # Bring the result to the layout of the replaced value
    made.dtype = ir.DataType.FLOAT
    made.shape = ir.Shape(sizes(form.result))
    return laid_out(call, View(made, form.result), chosen.result.layout)


def _weights(call: FusedCall, chosen: Plan, form: "_Form") -> ir.Value:
    factors = [*chosen.weights.views, *([chosen.mask] if chosen.mask else [])]
    value = combined(call, "Mul", factors, form.weights(None))
    scale = chosen.found.scale
    return (
        value if scale == 1.0 else call.add("Mul", [value, call.numbers(scale, value)])
    )


@dataclasses.dataclass(frozen=True)
class _Form:
    """The layouts of the fused node's operands, for a number of heads."""

    found: Decomposed
    heads: int

    def value(self, level: int | None) -> Layout:
        levels = self.found.levels
        total = sum(each.pixels for each in levels)
        pixels = whole(PIXEL, total if level is None else levels[level].pixels)
        outer = self._outer((*self.found.images, *pixels))
        return (*outer, whole(CHANNEL, self.found.channels))

    def locations(self, level: int | None) -> Layout:
        return (*self.weights(level), whole(XY, 2))

    def weights(self, level: int | None) -> Layout:
        levels = len(self.found.levels) if level is None else 1
        outer = self._outer(self.found.queries)
        both = (*self.found.images, *whole(LEVEL, levels))
        return (*outer, both, self.found.points)

    @property
    def result(self) -> Layout:
        outer = self._outer(self.found.queries)
        return (*outer, whole(CHANNEL, self.found.channels))

    def result_cost(self, view: View) -> float:
        return cost_of(View(view.value, self.result), view.layout)

    def _outer(self, middle: tuple[Digit, ...]) -> Layout:
        images = self.found.batch // self.heads
        batch = (Digit(BATCH, self.heads, images),) if images > 1 else ()
        # Images that are added up become levels
        kept = split_like(batch, self.found.images)
        kept = tuple(digit for digit in kept if digit not in self.found.images)
        return (kept, middle, whole(BATCH, self.heads))


def _head_counts(found: Decomposed, views: Sequence[View]) -> list[int]:
    """Return the numbers of heads that the layouts suggest, largest first."""
    counts = {1, found.batch}
    for view in views:
        for digit in flat(view.layout):
            if digit.axis == BATCH:
                counts |= {digit.stride, digit.end}
    least = min((digit.stride for digit in found.images), default=found.batch)
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
