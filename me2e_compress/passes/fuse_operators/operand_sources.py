"""Find where an operand of the fused node can be read, and what its layout costs."""

import dataclasses
import math
from collections.abc import Callable, Sequence

from me2e_compress.passes.digits import (
    Digit,
    Layout,
    flat,
    merged,
    sizes,
    split_like,
    whole,
)
from me2e_compress.passes.fuse_operators.decomposed import LEVEL, PIXEL, XY
from me2e_compress.passes.fuse_operators.views import (
    Selection,
    View,
    joined,
    sources,
    terms,
)


@dataclasses.dataclass(frozen=True)
class Source:
    """The views of an operand: one, or one per level, or the two terms of a sum."""

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
    """Return where an operand can be read: per level, then from all levels together."""
    # Walk back from each level
    walks = [list(sources(view)) for view in views]
    ends = [walk[-1] for walk in walks]
    options = [
        Source(option)
        for option in zip(
            *([each for each in walk if isinstance(each, View)] for walk in walks),
            strict=False,  # a level may be read from further away than another
        )
    ]
    # Where all levels are selections of one value, read that
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
    """Return where a value can be read as a whole and unscaled."""
    found = (each for each in sources(view) if isinstance(each, View))
    return [each for each in found if _same(each, view)]


def sums_of(option: Source) -> list[Source]:
    """Return where the two terms of an operand can be read, if it is an unscaled sum.

    Positions are often the sum of few reference points and offsets, cheaper to move.
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
    """Return the lowest cost of laying out a source, and the last such source.

    ``covered`` are digits that another operator repeats the operand over anyway.
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
    """Return the bytes written to bring a view to a layout.

    The view need not be repeated over ``covered`` digits, nor at all as a ``part`` of a
    sum or product, which repeats it and is scaled elsewhere.
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
