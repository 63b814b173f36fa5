"""Roads without junctions: several lanes one way, one lane each way, with parking."""

import math
from dataclasses import dataclass

from me2e_compress.simulator.plane_geometry import Command
from me2e_compress.simulator.scenarios.layouts.carriageway import (
    Arc,
    Carriageway,
    Piece,
    Straight,
    carriageway,
    straight_section,
)
from me2e_compress.simulator.traffic.legs import Leg
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    LaneIndex,
    Pose,
)
from me2e_compress.simulator.traffic.stage import Stage

BEFORE_M = 60.0
"""Road behind the ego's start, from where others catch up."""
BEYOND_M = 120.0
"""Road beyond the goal."""
GOAL_M = 150.0
PARKING_M = 2.5
"""Width of a parking lane."""


@dataclass(frozen=True)
class Street:
    """A road on which the ego follows one lane.

    ``start_m`` is the arc length along the road at which the ego's route begins.
    """

    road: Carriageway
    lane: int
    start_m: float

    def ahead(self, lane: int) -> list[LaneIndex]:
        """Return the chain of a forward lane."""
        return self.road.ahead(lane)

    def other_lane(self) -> int:
        """Return a lane beside the ego's."""
        return self.lane - 1 if self.lane > 0 else self.lane + 1


def origin(stage: Stage) -> Pose:
    """Return the pose at which the world begins, with a random heading."""
    return Pose(0.0, 0.0, stage.uniform("heading_rad", -math.pi, math.pi))


def start_speed(stage: Stage) -> float:
    """Return the ego's speed at frame 0 (m/s)."""
    return stage.uniform("speed_mps", 7.0, 10.0)


def multilane(stage: Stage) -> Street:
    """Lay a straight one-way road of two or three lanes and a narrow shoulder."""
    stage.layout = "multilane"
    lanes = stage.integer("lanes", 2, 3)
    lane = min(stage.integer("ego_lane", 0, lanes - 1), lanes - 1)
    pieces = [Straight(BEFORE_M + GOAL_M + BEYOND_M)]
    return _street(stage, pieces, lanes, lane, oncoming=0, limit_mps=14.0, shoulder=1.0)


def single_lane(stage: Stage) -> Street:
    """Lay a straight one-way road of one lane, without room to overtake."""
    stage.layout = "single_lane"
    pieces = [Straight(BEFORE_M + GOAL_M + BEYOND_M)]
    return _street(stage, pieces, 1, 0, oncoming=0, limit_mps=14.0, shoulder=0.5)


def bend(stage: Stage) -> Street:
    """Lay a one-way road of two or three lanes through a bend."""
    stage.layout = "bend"
    lanes = stage.integer("lanes", 2, 3)
    lane = min(stage.integer("ego_lane", 0, lanes - 1), lanes - 1)
    pieces = _curve(stage, 60.0, 100.0)
    return _street(stage, pieces, lanes, lane, oncoming=0, limit_mps=14.0, shoulder=1.0)


def two_way(stage: Stage) -> Street:
    """Lay a straight road, one lane each way; overtaking uses the oncoming lane."""
    stage.layout = "two_way"
    pieces = [Straight(BEFORE_M + GOAL_M + BEYOND_M)]
    return _street(stage, pieces, 1, 0, oncoming=1, limit_mps=13.0, shoulder=0.6)


def two_way_bend(stage: Stage) -> Street:
    """Lay a winding road with one lane each way and a paved shoulder."""
    stage.layout = "two_way_bend"
    pieces = _curve(stage, 50.0, 90.0)
    return _street(stage, pieces, 1, 0, oncoming=1, limit_mps=12.0, shoulder=1.8)


def parking_street(stage: Stage) -> Street:
    """Lay a street with one lane each way and a parking lane on either side."""
    stage.layout = "parking_street"
    pieces = [Straight(BEFORE_M + GOAL_M + BEYOND_M)]
    return _street(stage, pieces, 1, 0, oncoming=1, limit_mps=12.0, shoulder=PARKING_M)


def parking_bay(stage: Stage) -> Street:
    """Lay the parking street; the ego starts, at rest, in the parking lane."""
    stage.layout = "parking_bay"
    pieces = [Straight(BEFORE_M + GOAL_M + BEYOND_M)]
    section = straight_section(1, 12.0)
    road = carriageway(stage.network, "r", origin(stage), pieces, section, 1, PARKING_M)
    stay = stage.uniform("stay_m", 8.0, 12.0)
    (bay,), (lane,) = road.shoulder(), road.ahead(0)
    legs = [
        Leg(bay, enter_m=BEFORE_M, leave_m=BEFORE_M + stay),
        Leg(lane, Command.CHANGE_LEFT, enter_m=BEFORE_M + stay + 14.0),
    ]
    stage.drive(legs, 2.0)
    return Street(road, 0, BEFORE_M)


def zebra_street(stage: Stage) -> Street:
    """Lay a two-way street with a marked crosswalk; see `Stage.crosswalks`."""
    street = two_way(stage)
    stage.layout = "zebra_street"
    s = stage.uniform("crosswalk_m", 55.0, 80.0)
    corners = [
        stage.route_pose(s + along, across)
        for along, across in (
            (-2.0, 1.5 * LANE_WIDTH_M),
            (2.0, 1.5 * LANE_WIDTH_M),
            (2.0, -0.5 * LANE_WIDTH_M),
            (-2.0, -0.5 * LANE_WIDTH_M),
        )
    ]
    a, b, c, d = ((corner.x, corner.y) for corner in corners)
    stage.crosswalks.append((a, b, c, d))
    return street


def _curve(stage: Stage, tightest: float, widest: float) -> list[Piece]:
    radius = stage.uniform("radius_m", tightest, widest)
    side = 1.0 if stage.choice("bend", ("left", "right")) == "left" else -1.0
    angle = 60.0 / radius
    return [
        Straight(BEFORE_M + 30.0),
        Arc(radius, side * angle),
        Straight(GOAL_M - 90.0 + BEYOND_M),
    ]


def _street(
    stage: Stage,
    pieces: list[Piece] | list[Straight],
    lanes: int,
    lane: int,
    oncoming: int,
    limit_mps: float,
    shoulder: float,
) -> Street:
    section = straight_section(lanes, limit_mps)
    road = carriageway(
        stage.network, "r", origin(stage), pieces, section, oncoming, shoulder
    )
    first, *others = road.ahead(lane)
    legs = [Leg(first, enter_m=BEFORE_M), *(Leg(index) for index in others)]
    stage.drive(legs, start_speed(stage), GOAL_M)
    return Street(road, lane, BEFORE_M)
