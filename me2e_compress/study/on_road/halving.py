"""Successive halving over routes: all drive a few, the better half drives more.

Karnin, Koren and Somekh, "Almost optimal exploration in multi-armed bandits" (2013);
Jamieson and Talwalkar (2016). Routes are the budget, and each rung's routes begin with
those of the rung before, so that nothing is driven twice.
"""

import random
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean

from me2e_compress.simulator.routes import Route

FINAL = 2
"""So many are left for all routes."""

Differ = Callable[[str, Sequence[Route]], Sequence[float]]
"""Drives one of them over routes: points of driving score beside the reference's."""


@dataclass(frozen=True)
class Standing:
    """One of them on one rung.

    Attributes:
        name: Its name.
        difference: Mean over the rung's routes, points of driving score.
        kept: Whether it goes on, or, on the last rung, wins.
    """

    name: str
    difference: float
    kept: bool


@dataclass(frozen=True)
class Rung:
    """What so many routes showed.

    Attributes:
        routes: How many.
        standings: Best first; of equal ones the one that was named first.
    """

    routes: int
    standings: tuple[Standing, ...]


def halve(
    names: Sequence[str],
    routes: Sequence[Route],
    first: int,
    differ: Differ,
    on_rung: Callable[[Rung], None] = lambda rung: None,
) -> tuple[Rung, ...]:
    """Drive all over the first routes, the better half over twice as many, and so on.

    The last two, or all where there are no more routes, drive every route; the best of
    these wins.

    Args:
        names: At least one, the preferred ones first.
        routes: In the order of :func:`stratified`.
        first: Routes of the first rung.
        differ: Drives.
        on_rung: Is called with each rung.

    Returns:
        Rung by rung; the first of the last one wins.
    """
    left, rungs = list(names), list[Rung]()
    for size in sizes(len(left), len(routes), first):
        found = {name: fmean(differ(name, routes[:size])) for name in left}
        order = sorted(left, key=lambda name: -found[name])
        left = order[: 1 if size == len(routes) else kept(len(order))]
        standings = (Standing(name, found[name], name in left) for name in order)
        rungs.append(Rung(size, tuple(standings)))
        on_rung(rungs[-1])
    return tuple(rungs)


def sizes(names: int, routes: int, first: int) -> Iterator[int]:
    """Yield the routes of each rung, all of them at the end.

    Args:
        names: How many begin.
        routes: How many there are.
        first: Routes of the first rung.
    """
    size = first
    while names > FINAL and size < routes:
        yield size
        names, size = kept(names), 2 * size
    yield routes


def kept(names: int) -> int:
    """Return how many of a rung go on: the upper half, and two at least."""
    return max(FINAL, (names + 1) // 2)


def drives(names: int, routes: int, first: int) -> int:
    """Return how many routes are driven in all, the reference's included."""
    driven, before = 0, 0
    for size in sizes(names, routes, first):
        driven += names * (size - before)
        names, before = kept(names), size
    return driven + routes


def stratified(routes: Sequence[Route], seed: int) -> tuple[Route, ...]:
    """Order routes so that every beginning is as mixed as the whole.

    No scenario type comes a second time before all have come once, and so on; within
    such a round abilities are spread evenly.

    Args:
        routes: In any order; it does not count.
        seed: Which type, and which route of it, comes first.
    """
    draw = random.Random(seed)
    by_type = defaultdict[str, list[Route]](list)
    for route in sorted(routes, key=lambda each: each.id):
        by_type[route.scenario].append(route)
    by_ability = defaultdict[str, list[str]](list)
    for name, own in sorted(by_type.items()):
        draw.shuffle(own)
        by_ability[own[0].ability].append(name)
    place = dict[str, float]()
    for _, types in sorted(by_ability.items()):
        draw.shuffle(types)
        place |= {name: (at + 0.5) / len(types) for at, name in enumerate(types)}
    types = sorted(by_type, key=lambda name: (place[name], name))
    rounds = max(map(len, by_type.values()), default=0)
    return tuple(
        by_type[name][turn]
        for turn in range(rounds)
        for name in types
        if turn < len(by_type[name])
    )
