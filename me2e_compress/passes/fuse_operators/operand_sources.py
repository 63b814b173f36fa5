"""Where an operand of the fused node may be read, and what laying it out costs."""

import dataclasses
import math
from collections.abc import Callable, Sequence

from me2e_compress.passes.fuse_operators.decomposed import LEVEL, PIXEL, XY
from me2e_compress.passes.fuse_operators.digits import (
    Digit,
    Layout,
    flat,
    merged,
    sizes,
    split_like,
    whole,
)
from me2e_compress.passes.fuse_operators.views import (
    Selection,
    View,
    joined,
    sources,
    terms,
)


@dataclasses.dataclass(frozen=True)
class Source:
    """Where an operand comes from.

    Attributes:
        views: one of the whole operand; or one of every level; or two that add up.
        total: whether they add up.
    """

    views: tuple[View, ...]
    total: bool = False


def join_pixels(selections: Sequence[Selection]) -> View | None:
    """Join feature maps that were cut from one row of pixels, level after level."""
    for each in selections:
        digits = merged(each.view.layout[each.axis])
        if digits != whole(PIXEL, each.size):
            return None
    return joined(selections, whole(PIXEL, sum(each.size for each in selections)))


def join_levels(selections: Sequence[Selection]) -> View | None:
    """Join positions that were cut from one row of levels."""
    first = selections[0]
    digits = first.view.layout[first.axis]
    if any(each.view.layout[each.axis] != digits for each in selections):
        return None
    return joined(selections, (*whole(LEVEL, len(selections)), *digits))


def options_of(
    views: Sequence[View], join: Callable[[Sequence[Selection]], View | None]
) -> list[Source]:
    """List where an operand may be read: of every level, then of all together."""
    walks = [list(sources(view)) for view in views]
    ends = [walk[-1] for walk in walks]
    options = [
        Source(option)
        for option in zip(
            *([each for each in walk if isinstance(each, View)] for walk in walks),
            strict=False,  # a level may be read from further away than another
        )
    ]
    selections = [each for each in ends if isinstance(each, Selection)]
    if len(selections) < len(ends):
        return options
    first = selections[0]
    together = (
        joined(selections, first.view.layout[first.axis])
        if len(selections) == 1
        else join(selections)
    )
    return options if together is None else [*options, *options_of([together], join)]


def whole_views(view: View) -> list[View]:
    """List where a value may be read as a whole, and unscaled."""
    found = (each for each in sources(view) if isinstance(each, View))
    return [each for each in found if _same(each, view)]


def sums_of(option: Source) -> list[Source]:
    """List where the two may be read that an operand is the sum of.

    Positions are often the sum of a few reference points and of offsets: what is moved
    before that is smaller. Only where the sum itself needs no scale.
    """
    if len(option.views) != 1 or scaling(option.views[0]) != (1.0, 0.0):
        return []
    parts = terms(option.views[0])
    if parts is None:
        return []
    first, second = (
        [v for v in sources(part) if isinstance(v, View) and v.shift == part.shift]
        for part in parts
    )
    return [Source((a, b), total=True) for a in first for b in second]


def _same(view: View, other: View) -> bool:
    return (view.scale, view.shift) == (other.scale, other.shift)


def cheapest(
    options: Sequence[Source],
    form: Callable[[int | None], Layout],
    covered: tuple[Digit, ...] = (),
) -> tuple[float, Source]:
    """Return the source that costs least to lay out; of equals the last one.

    Args:
        options: to choose from.
        form: the layout, by level.
        covered: digits that something else repeats the operand over anyway.
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
    view: View,
    form: Layout,
    *,
    covered: tuple[Digit, ...] = (),
    part: bool = False,
) -> float:
    """Count the bytes that are written to lay a view out.

    Args:
        view: what is laid out.
        form: how.
        covered: digits that it need not be repeated over.
        part: whether it is one of several that are added or multiplied: such are
            repeated by that, and scaled wherever they are read.
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
    """Return what a view's elements are multiplied by, and what is added then.

    A grid's are taken from -1..1, between the outer edges, to 0..1.
    """
    if not any(digit.axis == XY for digit in flat(view.layout)):
        return view.scale, view.shift
    return view.scale / 2, (view.shift + 1) / 2
