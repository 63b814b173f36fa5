"""The roads and the actors of each scenario type, by Bench2Drive's names."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scenarios import actors, flows, roads
from me2e_compress.simulator.scenarios.crossings import (
    Crossing,
    crosswalk_junction,
    junction,
    roundabout,
    signal_junction,
)
from me2e_compress.simulator.scenarios.flows import Traffic, stream
from me2e_compress.simulator.scene import ActorKind, SignalKind, SignalState
from me2e_compress.simulator.traffic.network import LaneIndex, LaneTable, Network
from me2e_compress.simulator.traffic.stage import Script, Stage

# Background of a route: traffic on every lane, people beside it.


FAST_MPS = 13.5  # roads with a higher limit carry more traffic
GAP_S, FAST_GAP_S = (6.5, 10.5), (3.5, 6.5)  # mean between cars of a lane
WALKER_EVERY_M = (11.0, 20.0)  # mean distance between two people beside the road
CYCLIST = 0.25  # share of them who ride
WALK_MPS, RIDE_MPS = (1.0, 1.7), (3.0, 5.0)
NEAR_M, MOST = 45.0, 26  # of people: farthest from the route, and number
ASIDE_M = (0.9, 1.5, 2.2, 3.0, 4.0, 5.0)  # from a lane's edge to people beside it
OFF_M, END_M = 0.5, 10  # a line's distance from lanes, and from its ends


def populate(stage: Stage) -> None:
    """Put traffic on every lane that no script uses, and people beside the roads."""
    network, schedule = stage.network, stage.schedule
    calm = stage.uniform("gap_s", *GAP_S)
    fast = stage.uniform("fast_gap_s", *FAST_GAP_S)
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
    excluded = [*network.shoulders, *network.closed]
    return [index for index in follows if index not in led_to and index not in excluded]


def chains_from(network: Network, entry: LaneIndex) -> Iterator[list[LaneIndex]]:
    """Yield every way from a lane out of the map."""
    follows = _successors(network)
    waiting = [[entry]]
    while waiting:
        chain = waiting.pop()
        if chain[-1] in network.closed:
            continue
        after = follows[chain[-1]]
        passed = {node for index in chain for node in index[:2]}
        onward = [index for index in after if index[1] not in passed]
        waiting += [[*chain, index] for index in reversed(onward)]
        if not after:
            yield chain


def _successors(network: Network) -> dict[LaneIndex, list[LaneIndex]]:
    """Return the lanes that begin where a lane ends."""
    lanes = [e for e in network.graph.lanes_dict() if e not in network.shoulders]
    begins = np.array([network.centre(index)[0] for index in lanes])
    successors: dict[LaneIndex, list[LaneIndex]] = {}
    for index in lanes:
        away = np.hypot(*(begins - network.centre(index)[-1]).T)
        nearby = [lanes[i] for i in np.flatnonzero(away < 0.5).tolist()]
        successors[index] = [lane for lane in nearby if lane[0] == index[1]]
    return successors


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
            speed = float(random.uniform(*(RIDE_MPS if rides else WALK_MPS)))
            kind = ActorKind.BICYCLE if rides else ActorKind.PEDESTRIAN
            away = np.hypot(*(stage.path.points - part[begin]).T).min()
            if away > NEAR_M or len(stage.bodies) >= most:
                continue
            walker = stage.add_walker(kind, part[begin:], speed)
            walker.going, walker.speed = True, speed


def pavements(network: Network) -> Iterator[Floats]:
    """Yield the lines, in driving direction, on which people walk beside lanes."""
    table = LaneTable(network.graph)
    half = np.array([network.lane(index).width for index in table.column]) / 2
    for index in network.graph.lanes_dict():
        if index in network.ranks or index in network.shoulders:
            continue
        # people walk beside the outer lanes: more to the right than to the left
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
        sides = set[bool]()
        for aside in asides:
            # the nearest line on each side that is off every road
            if (aside > 0) in sides:
                continue
            line = centre + (math.copysign(width / 2, aside) + aside) * normal
            s, r = table.coordinates(line * (1.0, -1.0))
            inside = (np.abs(r) < half + OFF_M) & (s > -OFF_M)
            inside &= s < table.length + OFF_M
            run = _longest(~np.max(inside, axis=1))
            if run is not None and run[1] - run[0] > 3 * END_M:
                sides.add(aside > 0)
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
LEFT, RIGHT, AHEAD = ("left",), ("right",), ("ahead",)
TURNS = ("left", "right")
MOVES = ("left", "right", "ahead")
# The ego comes out of a side road
SIDE_ROAD = partial(junction, sign=SignalKind.GIVE_WAY, arms=("left", "back", "right"))


def lights(
    moves: tuple[str, ...], ego_light: SignalState | None = SignalState.GREEN
) -> Callable[[Stage], Crossing]:
    """Return the layout of a junction with lights; see `signal_junction`."""
    return partial(signal_junction, moves=moves, ego_light=ego_light)


def overtaking(
    obstacle: Callable[[Stage, roads.Street], Script],
    road: Callable[[Stage], roads.Street] = roads.two_way,
) -> tuple[Callable[..., Any], ...]:
    """Return a two-way road with an obstacle, and oncoming cars in the lane beside."""
    return road, obstacle, actors.oncoming_cars


def give_way(moves: tuple[str, ...]) -> Callable[[Stage], Crossing]:
    """Return the layout of a junction at which the ego has a give-way sign."""
    # In the types without it, others have it, or nobody
    return partial(junction, moves=moves, sign=SignalKind.GIVE_WAY)


STRAIGHT_ON = partial(junction, moves=AHEAD)
# Traffic from the left; the background brings some from the right
FROM_SIDE = partial(flows.FROM_LEFT, cars=False)

# A layout, and the scripts that put actors on what it returns, in this order
SCENARIOS: dict[str, tuple[Callable[..., Any], ...]] = {
    # something stands or crawls in the lane: go round it
    "Accident": (roads.multilane, actors.crashed_cars),
    "AccidentTwoWays": overtaking(actors.crashed_cars),
    "ConstructionObstacle": (roads.multilane, actors.construction),
    "ConstructionObstacleTwoWays": overtaking(actors.construction),
    "HazardAtSideLane": (roads.multilane, actors.slow_cyclists),
    "HazardAtSideLaneTwoWays": overtaking(actors.slow_cyclists),
    "ParkedObstacle": (roads.bend, actors.parked_car),
    "ParkedObstacleTwoWays": overtaking(actors.parked_car),
    "VehicleOpensDoorTwoWays": overtaking(actors.opening_door, roads.parking_street),
    # join, cross or leave moving traffic; latecomers may ignore the ego's green
    "CrossingBicycleFlow": (lights(TURNS), actors.bicycle_stream),
    "EnterActorFlow": (roundabout, flows.ring_flow),
    "HighwayExit": (roads.off_ramp, flows.exit_lane_flow),
    "InterurbanActorFlow": (
        partial(junction, moves=LEFT, arms=("ahead", "left", "back"), limit_mps=16.0),
        flows.ONCOMING,
    ),
    "HighwayCutIn": (partial(roads.on_ramp, ego_on_ramp=False), actors.ramp_cut_in),
    "InterurbanAdvancedActorFlow": (
        partial(SIDE_ROAD, moves=LEFT, lanes=2, limit_mps=14.0),
        partial(FROM_SIDE, name="near_and_far_flow"),
    ),
    "MergerIntoSlowTrafficV2": (roads.lane_drop, actors.slow_queue),
    "MergerIntoSlowTraffic": (roads.on_ramp, actors.slow_queue),
    "NonSignalizedJunctionLeftTurn": (partial(junction, moves=LEFT), flows.ONCOMING),
    "NonSignalizedJunctionRightTurn": (give_way(RIGHT), flows.FROM_LEFT),
    "NonSignalizedJunctionLeftTurnEnterFlow": (give_way(LEFT), flows.TO_ENTER),
    "ParkingExit": (roads.parking_bay, flows.bay_flow),
    "SequentialLaneChange": (roads.four_lanes, flows.side_flows),
    "SignalizedJunctionLeftTurn": (lights(LEFT), flows.ONCOMING),
    "SignalizedJunctionRightTurn": (lights(RIGHT), flows.FROM_LEFT),
    "SignalizedJunctionLeftTurnEnterFlow": (
        lights(LEFT),
        partial(flows.TO_ENTER, late=True),
    ),
    # another road user appears suddenly
    "BlockedIntersection": (lights(MOVES, None), actors.blocked_exit),
    "DynamicObjectCrossing": (roads.two_way, actors.walker_behind_van),
    "HardBreakRoute": (roads.single_lane, actors.hard_brake),
    "OppositeVehicleTakingPriority": (STRAIGHT_ON, flows.crossing_car),
    "OppositeVehicleRunningRedLight": (lights(AHEAD), flows.crossing_car),
    "ParkingCutIn": (roads.parking_street, actors.pull_out),
    "PedestrianCrossing": (roads.zebra_street, actors.walkers_on_zebra),
    "ParkingCrossingPedestrian": (roads.parking_street, actors.walker_between_cars),
    "StaticCutIn": (roads.multilane, actors.queue_cut_in),
    "VehicleTurningRoute": (lights(TURNS, None), actors.cyclists_on_exit),
    "VehicleTurningRoutePedestrian": (
        partial(crosswalk_junction, moves=TURNS),
        actors.pedestrians_on_exit,
    ),
    "ControlLoss": (roads.bend, actors.spun_car),
    # make room
    "InvadingTurn": (roads.two_way_bend, flows.invader),
    "YieldToEmergencyVehicle": (roads.multilane, flows.emergency_behind),
    # obey the lights and signs at the junction
    "T_Junction": (
        partial(SIDE_ROAD, moves=TURNS),
        partial(FROM_SIDE, name="flows_from_both_sides"),
    ),
    "VanillaNonSignalizedTurn": (give_way(TURNS), flows.priority_car),
    "VanillaSignalizedTurnEncounterGreenLight": (lights(TURNS), actors.queue_at_light),
    "VanillaSignalizedTurnEncounterRedLight": (
        lights(TURNS, SignalState.RED),
        flows.red_light,
    ),
    "VanillaNonSignalizedTurnEncounterStopsign": (
        partial(junction, moves=TURNS, sign=SignalKind.STOP_SIGN),
        flows.stop_sign,
    ),
}


def stage_of(route: Route, builder: Builder | None = None) -> Stage:
    """Set up a route: roads, actors and scripts; a ``builder`` brings its traffic."""
    stage = Stage(route)
    if builder is None:
        layout, *scripts = SCENARIOS[route.scenario]
        place = layout(stage)
        for script in scripts:
            stage.play_script(script(stage, place))
        populate(stage)
    else:
        builder(stage)
    stage.schedule.arrivals.sort(key=lambda arrival: (arrival[0], arrival[1].id))
    return stage
