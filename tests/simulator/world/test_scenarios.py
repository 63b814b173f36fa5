import numpy as np
import pytest

from me2e_compress.metrics.bench2drive import ABILITIES
from me2e_compress.simulator.routes import (
    EXPERT_S,
    SCENARIO_ABILITIES,
    Route,
    load_routes,
)
from me2e_compress.simulator.scenarios.builders import SCENARIOS, stage_of
from me2e_compress.simulator.traffic.traffic_road import overlap
from me2e_compress.simulator.world import World
from tests.simulator.world.driving import drive_blind, route_of

TYPES = tuple(SCENARIO_ABILITIES)


def test_there_are_the_44_types_of_bench2drive() -> None:
    sizes = [
        sum(ability in found for found in SCENARIO_ABILITIES.values())
        for ability in ABILITIES
    ]

    assert len(TYPES) == 44
    assert set(SCENARIOS) == set(TYPES) == set(EXPERT_S)
    assert sizes == [9, 16, 12, 2, 19]


@pytest.mark.parametrize("route", load_routes()[::5], ids=lambda route: route.scenario)
def test_who_does_not_look_fails(route: Route) -> None:
    assert any(drive_blind(route, speed).infractions for speed in (12.0, 8.0))


@pytest.mark.parametrize("name", TYPES)
def test_its_route_is_drivable_and_nobody_overlaps_at_the_start(name: str) -> None:
    for seed in range(3):
        world = World(route_of(name, seed))
        path = world.path
        bends = np.abs(np.diff(path.headings))
        steps = np.hypot(*np.diff(path.points, axis=0).T)
        stage = stage_of(route_of(name, seed))
        bodies = [stage.ego, *stage.bodies, *stage.static_objects]
        # people beside the road may begin at one place
        bodies = [body for body in bodies if not getattr(body, "going", False)]

        assert path.length_m >= path.goal_m + 40
        assert bends.max() < 0.12  # a radius of 8.3 m: the ego can turn in 7.6 m
        assert 0.98 < steps.min() <= steps.max() < 1.001
        assert world.roadmap.outside_all(path.points).max() == 0
        assert not any(
            overlap(a, b) for i, a in enumerate(bodies) for b in bodies[i + 1 :]
        )


@pytest.mark.parametrize("name", ["AccidentTwoWays", "Accident", "ParkingExit"])
def test_the_room_beside_a_route_is_what_the_map_shows(name: str) -> None:
    world = World(route_of(name, 2))
    path = world.path
    for s in range(5, 150, 10):
        for sign, room in ((-1, path.right_m[s]), (1, path.oncoming_m[s])):
            inside = path.at(s, sign * (room - 0.05))
            outside = path.at(s, sign * (room + 0.35))
            assert world.roadmap.outside_m(float(inside[0]), float(inside[1])) == 0
            if room < 8.5:
                far = world.roadmap.outside_m(float(outside[0]), float(outside[1]))
                assert far > 0
