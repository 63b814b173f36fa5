"""Successive halving, on routes that nobody drives."""

import random
from collections import Counter
from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.simulator.routes import Route, load_routes
from me2e_compress.study.on_road.halving import drives, halve, sizes, stratified

ALL = load_routes()
ROUTES = stratified(ALL, 0)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.integers(1, len(ALL)), st.integers(1, len(ALL)))
def test_every_beginning_is_as_mixed_as_the_whole(
    seed: int, count: int, size: int
) -> None:
    picked = random.Random(seed).sample(ALL, count)

    order = stratified(picked, seed)

    assert sorted(each.id for each in order) == sorted(each.id for each in picked)
    whole = Counter(each.scenario for each in picked)
    begun = Counter(each.scenario for each in order[:size])
    most = max(begun.values())
    assert all(begun[name] >= min(most - 1, of) for name, of in whole.items())


def test_the_order_is_the_seeds_alone() -> None:
    assert stratified(ALL[::-1], 3) == stratified(ALL, 3)
    assert stratified(ALL, 4) != stratified(ALL, 3)


def test_the_first_routes_are_of_every_ability() -> None:
    types = {each.scenario: each.ability for each in ROUTES}

    half = Counter(each.ability for each in ROUTES[: len(types) // 2])

    for ability, count in Counter(types.values()).items():
        assert abs(half[ability] - count / 2) <= 0.5


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 60), st.integers(1, 220), st.integers(1, 220))
def test_rungs_grow_and_end_with_all_routes(
    names: int, routes: int, first: int
) -> None:
    found = list(sizes(names, routes, first))

    assert found == sorted(set(found))
    assert found[-1] == routes
    assert 2 * routes <= drives(names, routes, first) <= (names + 1) * routes


class Noisy:
    """Drives by a known quality, and a noise of each route that seeds repeat."""

    def __init__(self, quality: dict[str, float], noise: float) -> None:
        self.quality, self.noise = quality, noise
        self.driven: set[tuple[str, str]] = set()

    def differ(self, name: str, routes: Sequence[Route]) -> list[float]:
        self.driven |= {(name, each.id) for each in routes}
        return [
            self.quality[name] + random.Random(f"{name} {each.id}").gauss(0, self.noise)
            for each in routes
        ]


def test_the_best_is_found_and_most_routes_are_never_driven() -> None:
    road = Noisy({f"n{at}": -0.5 * at for at in range(24)}, noise=12.0)

    rungs = halve(list(road.quality), ROUTES, 22, road.differ)

    assert [each.routes for each in rungs] == [22, 44, 88, 176, 220]
    assert [len(each.standings) for each in rungs] == [24, 12, 6, 3, 2]
    winner = rungs[-1].standings[0]
    assert winner.kept
    assert road.quality[winner.name] >= -2.0
    assert len(road.driven) + 220 == drives(24, 220, 22) == 1628


def test_without_noise_the_best_wins_whatever_the_order() -> None:
    road = Noisy({f"n{at}": float(at) for at in range(7)}, noise=0.0)

    rungs = halve(list(road.quality), ROUTES, 11, road.differ)

    assert rungs[-1].standings[0].name == "n6"
    assert [each.name for each in rungs[0].standings if each.kept] == [
        "n6",
        "n5",
        "n4",
        "n3",
    ]


def test_of_equal_ones_the_preferred_is_kept() -> None:
    road = Noisy(dict.fromkeys("abcd", 0.0), noise=0.0)

    rungs = halve("cabd", ROUTES, 22, road.differ)

    assert rungs[-1].standings[0].name == "c"
