"""Background of a route: traffic on every lane, people beside it."""

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scenarios.scripts.streams import Traffic, stream
from me2e_compress.simulator.scene import ActorKind
from me2e_compress.simulator.traffic.lanes import LaneTable
from me2e_compress.simulator.traffic.network import LaneIndex, Network
from me2e_compress.simulator.traffic.stage import Stage

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
