"""Timing of scripts: meeting points and synchronised arrivals."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scenarios.layouts.road import BEFORE_M
from me2e_compress.simulator.scenarios.scripts.streams import near
from me2e_compress.simulator.traffic.bodies import Walker
from me2e_compress.simulator.traffic.cars import Car
from me2e_compress.simulator.traffic.network import LaneIndex, Network
from me2e_compress.simulator.traffic.stage import Script, Stage

COMMIT_S = 4.0
"""A synchronised actor stops adapting when the ego is this close in time ..."""
COMMIT_M = 22.0
"""... or this close in space."""
NEAR_M = 30.0
"""A standing obstacle counts as met when the ego is this close."""
TOUCH_M = 1.0
TOP_MPS = 16.0
"""The most that a synchronised car drives to be in time."""


def chain_points(network: Network, chain: Sequence[LaneIndex]) -> tuple[Floats, Floats]:
    """Return the centre line [N, 2] of a chain and the arc length [N] of each point."""
    points, stations, done = list[Floats](), list[Floats](), 0.0
    for index in chain:
        centre, length = network.centre(index), network.length(index)
        points.append(centre)
        stations.append(done + np.linspace(0.0, length, len(centre)))
        done += length
    return np.concatenate(points), np.concatenate(stations)


def meeting(stage: Stage, chain: Sequence[LaneIndex]) -> tuple[float, float]:
    """Find where a chain of lanes meets the ego's route.

    Returns the arc length on the route and on the chain of the first crossing, or of
    the place where the one joins the other.
    """
    points, stations = chain_points(stage.network, chain)
    route = stage.path.points
    away = np.hypot(
        route[:, None, 0] - points[None, :, 0], route[:, None, 1] - points[None, :, 1]
    )
    nearest = away.min(axis=1)
    touching = np.flatnonzero(nearest < TOUCH_M)
    i = int(touching[0]) if len(touching) else int(np.argmin(nearest))
    for _ in range(2):
        i += int(i + 1 < len(nearest) and nearest[i + 1] < nearest[i])
    return float(i), float(stations[int(np.argmin(away[i]))])


def nearest_station(
    stage: Stage, chain: Sequence[LaneIndex], x: float, y: float
) -> float:
    """Return the arc length on a chain nearest to a point."""
    points, stations = chain_points(stage.network, chain)
    away = (points[:, 0] - x) ** 2 + (points[:, 1] - y) ** 2
    return float(stations[int(away.argmin())])


def arrive_together(
    stage: Stage,
    car: Car,
    route_s: float,
    station_m: float,
    name: str,
) -> Script:
    """Let a car reach its meeting point when the ego's centre does.

    Until the ego is within `COMMIT_S` or `COMMIT_M` the car adapts its speed to the
    ego's; then it keeps to the time foreseen at that moment, whatever the ego does, and
    drives on by IDM afterwards.
    """
    # adapt to the ego
    while (
        stage.arrival_s(route_s) > COMMIT_S
        and stage.ahead_m(route_s) - stage.ego.LENGTH / 2 > COMMIT_M
    ):
        due = stage.ahead_m(route_s) / max(stage.ego.speed, 2.0)
        _hurry(car, station_m, due, 1.0)
        yield
    # commit to the time foreseen now
    stage.fire(name, car)
    due = stage.time_s + stage.ahead_m(route_s) / max(stage.ego.speed, 3.0)
    while due - stage.time_s > 0.25 and car.station_m < station_m:
        _hurry(car, station_m, due - stage.time_s, 2.5)
        yield
    # drive on by IDM
    car.forced_mps2 = None
    car.target_speed = max(car.speed, 6.0)
    car.behaviour = replace(car.behaviour, sees_ego=True)


def _hurry(car: Car, station_m: float, due_s: float, slowest: float) -> None:
    wanted = (station_m - car.station_m) / max(due_s, 0.2)
    wanted = min(max(wanted, slowest), TOP_MPS)
    car.forced_mps2 = min(max((wanted - car.speed) / 0.4, -6.0), 5.0)


def steps_out(stage: Stage, walker: Walker, route_s: float, reach_m: float) -> Script:
    """Start a walker so that it and the ego's front reach the same place together.

    It crosses the ego's route at ``route_s``, ``reach_m`` from where it stands.
    """
    needed = reach_m / walker.top_speed_mps + 0.25
    walker.crosses = True
    yield from approach(stage, route_s, needed)
    walker.going = True


def approach(stage: Stage, route_s: float, arrival_s: float) -> Script:
    """Wait until the ego is near in time, or in space on the second road."""
    if stage.schedule is not None:
        yield from near(stage, route_s)
        return
    while stage.arrival_s(route_s) > arrival_s:
        yield


def met(stage: Stage, route_s: float, name: str) -> Script:
    """Note that the ego has come near a standing obstacle."""
    while stage.ahead_m(route_s) > NEAR_M:
        yield
    stage.fire(name)


def patience(
    stage: Stage, route_s: float, within_m: float, wait_s: float = 2.0
) -> Script:
    """Wait until the ego has stood before a place for a while.

    It never ends for a driver who does not stop; for one who waits too far away it ends
    25 s after coming within 45 m.
    """
    stood, near = 0.0, 0.0
    last = stage.time_s
    while stood < wait_s and near < 25.0:
        yield
        passed, last = stage.time_s - last, stage.time_s
        gap = stage.ahead_m(route_s) - stage.ego.LENGTH / 2
        stood = stood + passed if stage.ego.speed < 0.5 and gap < within_m else 0.0
        near = near + passed if gap < 45.0 else near


def hold(stage: Stage, seconds: float) -> Script:
    """Wait for some seconds."""
    end = stage.time_s + seconds
    while stage.time_s < end:
        yield


def stand(car: Car) -> None:
    """Keep a car where it is."""
    car.forced_mps2 = -4.0


def release(car: Car, target_mps: float) -> None:
    """Let a car drive by IDM."""
    car.forced_mps2, car.target_speed = None, target_mps


def keep_clear(stage: Stage, chain: Sequence[LaneIndex], until_s: float) -> None:
    """Let no traffic begin on a lane between the ego and a place of its route."""
    stage.clear[chain[0]] = (BEFORE_M - 8.0, BEFORE_M + until_s + 30.0)
