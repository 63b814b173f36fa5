"""The roads and the actors of each scenario type, by Bench2Drive's names."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scenarios.layouts.crossings import (
    crosswalk_junction,
    junction,
    roundabout,
    signal_junction,
)
from me2e_compress.simulator.scenarios.layouts.ramps import (
    four_lanes,
    lane_drop,
    off_ramp,
    on_ramp,
)
from me2e_compress.simulator.scenarios.layouts.streets import (
    bend,
    multilane,
    parking_bay,
    parking_street,
    single_lane,
    two_way,
    two_way_bend,
    zebra_street,
)
from me2e_compress.simulator.scenarios.scripts import crossers, flows, leads, obstacles
from me2e_compress.simulator.scenarios.scripts.streams import Traffic, stream
from me2e_compress.simulator.scene import ActorKind, SignalKind, SignalState
from me2e_compress.simulator.traffic.legs import LaneTable
from me2e_compress.simulator.traffic.network import LaneIndex, Network
from me2e_compress.simulator.traffic.stage import Script, Stage

# Background of a route: traffic on every lane, people beside it.


FAST_MPS = 13.5
"""Roads with a higher limit carry more traffic."""
GAP_S, FAST_GAP_S = (6.5, 10.5), (3.5, 6.5)
"""Mean time between two cars of a lane, by road class: 340 to 1030 vehicles an hour."""
WALKER_EVERY_M = (11.0, 20.0)
"""Mean distance between two people beside the road."""
CYCLIST = 0.25
"""Share of them who ride."""
WALK_MPS, RIDE_MPS = (1.0, 1.7), (3.0, 5.0)
NEAR_M, MOST = 45.0, 26
"""People are no farther from the route as they begin, and no more than these."""
ASIDE_M = (0.9, 1.5, 2.2, 3.0, 4.0, 5.0)
"""How far from the edge of a lane people may be; the nearest place off the road."""
OFF_M, END_M = 0.5, 10
"""Metres that a line keeps from every lane, and is shorter at its ends."""


def populate(stage: Stage) -> None:
    """Put traffic on every lane that no script uses, and people beside the roads."""
    network, schedule = stage.network, stage.schedule
    calm, fast = (
        stage.uniform("gap_s", *GAP_S),
        stage.uniform("fast_gap_s", *FAST_GAP_S),
    )
    for entry in entries(network):
        if entry in schedule.claimed:
            continue
        chains = list(chains_from(network, entry))
        if chains:
            quick = float(network.lane(entry).speed_limit) > FAST_MPS
            name = f"{entry[0]}>{entry[1]}:{entry[2]}"
            stream(stage, name, chains, Traffic(fast if quick else calm))
    _people(stage)


def entries(network: Network) -> list[LaneIndex]:
    """Return the lanes by which traffic comes into the map."""
    follows = _successors(network)
    led_to = {after for several in follows.values() for after in several}
    left_out = [*network.shoulders, *network.closed]
    return [index for index in follows if index not in led_to and index not in left_out]


def chains_from(network: Network, entry: LaneIndex) -> Iterator[list[LaneIndex]]:
    """Yield every way from a lane out of the map."""
    follows = _successors(network)
    waiting = [[entry]]
    while waiting:
        chain = waiting.pop()
        if chain[-1] in network.closed:
            continue
        after = follows[chain[-1]]
        seen = {node for index in chain for node in index[:2]}
        onward = [index for index in after if index[1] not in seen]
        waiting += [[*chain, index] for index in reversed(onward)]
        if not after:
            yield chain


def _successors(network: Network) -> dict[LaneIndex, list[LaneIndex]]:
    """Return the lanes that begin where a lane ends."""
    lanes = [e for e in network.graph.lanes_dict() if e not in network.shoulders]
    begins = np.array([network.centre(index)[0] for index in lanes])
    found: dict[LaneIndex, list[LaneIndex]] = {}
    for index in lanes:
        away = np.hypot(*(begins - network.centre(index)[-1]).T)
        found[index] = [lanes[i] for i in np.flatnonzero(away < 0.5).tolist()]
        found[index] = [each for each in found[index] if each[0] == index[1]]
    return found


def _people(stage: Stage) -> None:
    """Let people walk and ride beside the roads."""
    random = stage.random("people")
    every = stage.uniform("walker_every_m", *WALKER_EVERY_M)
    most = len(stage.bodies) + MOST
    lines = list(pavements(stage.network))
    for number in random.permutation(len(lines)).tolist():
        line = lines[number]
        length = float(np.hypot(*np.diff(line, axis=0).T).sum())
        for _ in range(int(random.poisson(length / every))):
            rides = random.random() < CYCLIST
            ahead = rides or random.random() < 0.5
            part = line if ahead else line[::-1]
            begin = int(random.integers(0, len(part) - 1))
            speed = float(
                random.uniform(3.0, 5.0) if rides else random.uniform(1.0, 1.7)
            )
            kind = ActorKind.BICYCLE if rides else ActorKind.PEDESTRIAN
            away = np.hypot(*(stage.path.points - part[begin]).T).min()
            if away > NEAR_M or len(stage.bodies) >= most:
                continue
            walker = stage.walker(kind, part[begin:], speed)
            walker.going, walker.speed = True, speed


def pavements(network: Network) -> Iterator[Floats]:
    """Yield the lines, in driving direction, on which people walk beside lanes."""
    table = LaneTable(network.graph)
    half = np.array([network.lane(index).width for index in table.column]) / 2
    for index in network.graph.lanes_dict():
        if index in network.ranks or index in network.shoulders:
            continue
        a, b, lane = index
        asides = list[float]()
        if lane == len(network.graph.graph[a][b]) - 1:
            asides += ASIDE_M
        if lane == 0:
            asides += [-metres for metres in ASIDE_M[:2]]
        centre, width = network.centre(index), float(network.lane(index).width)
        tangent = np.gradient(centre, axis=0)
        normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
        normal /= np.hypot(*normal.T)[:, None]
        found = set[bool]()
        for aside in asides:
            # the nearest line on each side that is off every road
            if (aside > 0) in found:
                continue
            line = centre + (math.copysign(width / 2, aside) + aside) * normal
            s, r = table.coordinates(line * (1.0, -1.0))
            inside = (np.abs(r) < half + OFF_M) & (s > -OFF_M)
            inside &= s < table.length + OFF_M
            run = _longest(~np.max(inside, axis=1))
            if run is not None and run[1] - run[0] > 3 * END_M:
                found.add(aside > 0)
                yield line[run[0] + END_M : run[1] - END_M]


def _longest(flags: npt.NDArray[np.bool_]) -> tuple[int, int] | None:
    """Return begin and end of the longest run of what is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    if not len(edges):
        return None
    begins, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - begins))
    return int(begins[best]), int(ends[best])


Builder = Callable[[Stage], None]
Place = TypeVar("Place")


def scenario(
    layout: Callable[[Stage], Place], *scripts: Callable[[Stage, Place], Script]
) -> Builder:
    """Return what lays roads and puts actors on them, in this order."""

    def build(stage: Stage) -> None:
        place = layout(stage)
        for script in scripts:
            stage.play(script(stage, place))

    return build


LEFT, RIGHT, AHEAD = ("left",), ("right",), ("ahead",)
TURNS = ("left", "right")
MOVES = ("left", "right", "ahead")
GIVING_WAY = partial(junction, sign=SignalKind.GIVE_WAY)
"""The ego has a give-way sign; in the types without it, others have, or nobody."""
SIDE_ROAD = partial(GIVING_WAY, arms=("left", "back", "right"))
"""The ego comes out of a side road."""

BUILDERS: dict[str, Builder] = {
    # something stands or crawls in the lane: go round it
    "Accident": scenario(multilane, obstacles.crashed_cars),
    "AccidentTwoWays": scenario(
        two_way, obstacles.crashed_cars, obstacles.oncoming_cars
    ),
    "ConstructionObstacle": scenario(multilane, obstacles.construction),
    "ConstructionObstacleTwoWays": scenario(
        two_way, obstacles.construction, obstacles.oncoming_cars
    ),
    "HazardAtSideLane": scenario(multilane, obstacles.slow_cyclists),
    "HazardAtSideLaneTwoWays": scenario(
        two_way, obstacles.slow_cyclists, obstacles.oncoming_cars
    ),
    "ParkedObstacle": scenario(bend, obstacles.parked_car),
    "ParkedObstacleTwoWays": scenario(
        two_way, obstacles.parked_car, obstacles.oncoming_cars
    ),
    "VehicleOpensDoorTwoWays": scenario(
        parking_street, obstacles.opening_door, obstacles.oncoming_cars
    ),
    # join, cross or leave moving traffic; latecomers may ignore the ego's green
    "CrossingBicycleFlow": scenario(
        partial(signal_junction, moves=TURNS), crossers.bicycle_stream
    ),
    "EnterActorFlow": scenario(roundabout, flows.ring_flow),
    "HighwayExit": scenario(off_ramp, flows.exit_lane_flow),
    "InterurbanActorFlow": scenario(
        partial(junction, moves=LEFT, arms=("ahead", "left", "back"), limit_mps=16.0),
        flows.oncoming_platoon,
    ),
    "HighwayCutIn": scenario(partial(on_ramp, ego_on_ramp=False), leads.ramp_cut_in),
    "InterurbanAdvancedActorFlow": scenario(
        partial(SIDE_ROAD, moves=LEFT, lanes=2, limit_mps=14.0),
        flows.near_and_far_flow,
    ),
    "MergerIntoSlowTrafficV2": scenario(lane_drop, leads.slow_queue),
    "MergerIntoSlowTraffic": scenario(
        partial(on_ramp, ego_on_ramp=True), leads.slow_queue
    ),
    "NonSignalizedJunctionLeftTurn": scenario(
        partial(junction, moves=LEFT), flows.oncoming_platoon
    ),
    "NonSignalizedJunctionRightTurn": scenario(
        partial(GIVING_WAY, moves=RIGHT), flows.platoon_from_left
    ),
    "NonSignalizedJunctionLeftTurnEnterFlow": scenario(
        partial(GIVING_WAY, moves=LEFT), flows.platoon_to_enter
    ),
    "ParkingExit": scenario(parking_bay, flows.bay_flow),
    "SequentialLaneChange": scenario(four_lanes, flows.side_flows),
    "SignalizedJunctionLeftTurn": scenario(
        partial(signal_junction, moves=LEFT), flows.oncoming_platoon
    ),
    "SignalizedJunctionRightTurn": scenario(
        partial(signal_junction, moves=RIGHT), flows.platoon_from_left
    ),
    "SignalizedJunctionLeftTurnEnterFlow": scenario(
        partial(signal_junction, moves=LEFT), flows.platoon_to_enter
    ),
    # another road user appears suddenly
    "BlockedIntersection": scenario(
        partial(junction, moves=MOVES, lights=True), leads.blocked_exit
    ),
    "DynamicObjectCrossing": scenario(two_way, crossers.walker_behind_van),
    "HardBreakRoute": scenario(single_lane, leads.hard_brake),
    "OppositeVehicleTakingPriority": scenario(
        partial(junction, moves=AHEAD), flows.crossing_car
    ),
    "OppositeVehicleRunningRedLight": scenario(
        partial(signal_junction, moves=AHEAD), flows.crossing_car
    ),
    "ParkingCutIn": scenario(parking_street, leads.pull_out),
    "PedestrianCrossing": scenario(zebra_street, crossers.walkers_on_zebra),
    "ParkingCrossingPedestrian": scenario(parking_street, crossers.walker_between_cars),
    "StaticCutIn": scenario(multilane, leads.queue_cut_in),
    "VehicleTurningRoute": scenario(
        partial(junction, moves=TURNS, lights=True), crossers.cyclists_on_exit
    ),
    "VehicleTurningRoutePedestrian": scenario(
        partial(crosswalk_junction, moves=TURNS), crossers.pedestrians_on_exit
    ),
    "ControlLoss": scenario(bend, obstacles.spun_car),
    # make room
    "InvadingTurn": scenario(two_way_bend, flows.invader),
    "YieldToEmergencyVehicle": scenario(multilane, flows.emergency_behind),
    # obey the lights and signs at the junction
    "T_Junction": scenario(
        partial(SIDE_ROAD, moves=TURNS), flows.flows_from_both_sides
    ),
    "VanillaNonSignalizedTurn": scenario(
        partial(GIVING_WAY, moves=TURNS), flows.priority_car
    ),
    "VanillaSignalizedTurnEncounterGreenLight": scenario(
        partial(signal_junction, moves=TURNS), leads.queue_at_light
    ),
    "VanillaSignalizedTurnEncounterRedLight": scenario(
        partial(signal_junction, moves=TURNS, ego_light=SignalState.RED),
        flows.red_light,
    ),
    "VanillaNonSignalizedTurnEncounterStopsign": scenario(
        partial(junction, moves=TURNS, sign=SignalKind.STOP_SIGN), flows.stop_sign
    ),
}


def stage_of(route: Route, builder: Builder | None = None) -> Stage:
    """Set up a route: its roads, its actors and their scripts.

    A ``builder`` of one's own brings its traffic, too.

    Raises:
        EvaluationError: A parameter of the route is wrong, or not one of its
            scenario's.
    """
    stage = Stage(route)
    if builder is None:
        BUILDERS[route.scenario](stage)
        populate(stage)
    else:
        builder(stage)
    stage.schedule.close()
    stage.complete()
    return stage
