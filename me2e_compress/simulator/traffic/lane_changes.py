"""Lane changes: MOBIL as in highway-env, and joining from a lane that ends.

MOBIL (Kesting, Treiber and Helbing 2007) with highway-env's constants, but for the
politeness, which each driver has for itself.
"""

import math

from highway_env.vehicle.objects import RoadObject

from me2e_compress.simulator.traffic.cars import Car
from me2e_compress.simulator.traffic.network import LaneIndex

EVERY = 10
"""Decisions between two looks: highway-env's LANE_CHANGE_DELAY is 1 s."""
MIN_GAIN_MPS2, MOST_IMPOSED_MPS2 = 0.2, 2.0
"""highway-env's LANE_CHANGE_MIN_ACC_GAIN and LANE_CHANGE_MAX_BRAKING_IMPOSED."""
JOIN_IMPOSED_MPS2 = 3.5
"""What somebody whose lane ends imposes on others: our choice."""
NEAREST_M = 2.0
"""Gap between bumpers below which nobody changes."""
SETTLED_M = 30.0
"""Nobody changes nearer than this to the beginning of a lane, or in a junction: who
comes up behind is on another lane yet."""
SLOWEST_MPS = 1.0


def consider(car: Car, lane_s: float, wanted_mps2: float) -> float:
    """Let a car change lanes if its driver does so now.

    Returns the acceleration that the driver wants then.
    """
    if car.joins is not None and car.leg == len(car.lanes) - 1:
        if _join(car, car.joins):
            car.joins = None
            return wanted_mps2
        end = car.network.length(car.lanes[-1]) - car.LENGTH / 2 - 2.0
        return min(wanted_mps2, car.idm_stop(max(end - lane_s, 0.1)))
    begins = car.leg > 0 and lane_s < SETTLED_M
    if car.behaviour.changes_lanes and not begins:
        _change(car, wanted_mps2)
    return wanted_mps2


def _change(car: Car, wanted_mps2: float) -> None:
    """Change to a lane beside if that is better, once a second."""
    if car.indicator and abs(car.road.seat(car, car.lanes[car.leg])[1]) < 0.4:
        car.indicator = 0
    car.until_change -= 1
    if car.until_change > 0 or car.speed < SLOWEST_MPS or car.indicator:
        return
    car.until_change = EVERY
    lane = car.lanes[car.leg][2]
    best, gained = None, MIN_GAIN_MPS2
    for side, other in ((1, lane - 1), (-1, lane + 1)):
        chain = _beside(car, other)
        if chain is None or (imposed := _imposed(car, chain)) > MOST_IMPOSED_MPS2:
            continue
        gain = _wanted(car, chain) - wanted_mps2
        gain -= car.behaviour.politeness * max(imposed, 0.0)
        if gain > gained:
            best, gained = (chain, side), gain
    if best is not None:
        car.change_lane(*best)


def _join(car: Car, chain: list[LaneIndex]) -> bool:
    """Leave a lane that ends for another one, if there is a gap."""
    station = car.network.lane(chain[0]).local_coordinates(car.position)[0]
    lanes, _ = car.network.rest(chain, float(station))
    if _imposed(car, lanes) > JOIN_IMPOSED_MPS2 or _wanted(car, lanes) < -4.0:
        return False
    car.change_lane(lanes, 1)
    return True


def _beside(car: Car, lane: int) -> list[LaneIndex] | None:
    """Return the rest of a car's chain in another lane; None if it is not all there."""
    graph, found = car.network.graph.graph, list[LaneIndex]()
    for a, b, _ in car.lanes[car.leg :]:
        if not 0 <= lane < len(graph[a][b]) or (a, b, lane) in car.network.closed:
            return None
        found.append((a, b, lane))
    return found


def _wanted(car: Car, chain: list[LaneIndex]) -> float:
    """Return the acceleration that a car would have on a chain."""
    lead, gap = car.road.lead(car, chain) or (None, math.inf)
    if gap < NEAREST_M:
        return -math.inf
    return car.idm(lead, gap, float(car.target_speed))


def _imposed(car: Car, chain: list[LaneIndex]) -> float:
    """Return the braking that a car imposes on who is behind it in another lane."""
    found = car.road.follower(car, chain[0])
    if found is None:
        return 0.0
    body, gap = found
    return math.inf if gap < NEAREST_M else -_following(body, car, gap)


def _following(body: RoadObject, lead: Car, gap_m: float) -> float:
    if isinstance(body, Car):
        return body.idm(lead, gap_m, float(body.target_speed))
    # the ego, or who follows no lane: what braking avoids a contact
    closing = max(float(body.speed) - float(lead.speed), 0.0)
    return -(closing**2) / (2 * gap_m) if closing else 0.0
