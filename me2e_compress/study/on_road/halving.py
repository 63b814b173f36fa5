"""Successive halving over routes: all drive a few, the better half drives more.

Karnin, Koren and Somekh, "Almost optimal exploration in multi-armed bandits" (2013);
Jamieson and Talwalkar (2016). Routes are the budget, and each rung's routes begin with
those of the previous rung, so that nothing is driven twice.
"""

import random
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean

from me2e_compress.simulator.routes import Route

FINAL = 2
"""Number of schemes that drive all routes."""

Differ = Callable[[str, Sequence[Route]], Sequence[float]]
"""Drives a scheme over routes: points of driving score minus the reference's."""


@dataclass(frozen=True)
class Standing:
    """One scheme on one rung; ``difference`` is a mean in points of driving score."""

    name: str
    difference: float
    kept: bool


@dataclass(frozen=True)
class Rung:
    """The standings after so many routes, best first; ties go to the first named."""

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

    The last two, or all if no routes are left, drive every route; the first of the last
    rung wins. ``names`` lists preferred ones first, ``routes`` are :func:`stratified`.
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
    """Yield the number of routes of each rung; the last has all of them."""
    size = first
    while names > FINAL and size < routes:
        yield size
        names, size = kept(names), 2 * size
    yield routes


def kept(names: int) -> int:
    """Return how many of a rung continue: the upper half, and at least two."""
    return max(FINAL, (names + 1) // 2)


def drives(names: int, routes: int, first: int) -> int:
    """Return how many routes are driven in all, including the reference's."""
    driven, before = 0, 0
    for size in sizes(names, routes, first):
        driven += names * (size - before)
        names, before = kept(names), size
    return driven + routes


def stratified(routes: Sequence[Route], seed: int) -> tuple[Route, ...]:
    """Order routes so that every prefix is as mixed as the whole.

    No scenario type occurs again before all have occurred once, and so on; within such
    a round abilities are spread evenly. The order of the input does not matter;
    ``seed`` decides which type, and which of its routes, comes first.
    """
    # shuffle the routes of each type
    draw = random.Random(seed)
    by_type = defaultdict[str, list[Route]](list)
    for route in sorted(routes, key=lambda each: each.id):
        by_type[route.scenario].append(route)
    by_ability = defaultdict[str, list[str]](list)
    for name, own in sorted(by_type.items()):
        draw.shuffle(own)
        by_ability[own[0].ability].append(name)
    # spread the types of each ability evenly over a round
    place = dict[str, float]()
    for _, types in sorted(by_ability.items()):
        draw.shuffle(types)
        place |= {name: (at + 0.5) / len(types) for at, name in enumerate(types)}
    types = sorted(by_type, key=lambda name: (place[name], name))
    # one route of every type per round
    rounds = max(map(len, by_type.values()), default=0)
    return tuple(
        by_type[name][turn]
        for turn in range(rounds)
        for name in types
        if turn < len(by_type[name])
    )
