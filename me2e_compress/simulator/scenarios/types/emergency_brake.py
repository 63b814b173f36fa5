"""Emergency_Brake: another road user appears suddenly."""

from me2e_compress.simulator.scenarios.layouts.crossings import (
    crosswalk_on,
    junction,
    signal_junction,
)
from me2e_compress.simulator.scenarios.layouts.streets import (
    bend,
    multilane,
    parking_street,
    single_lane,
    two_way,
    zebra_street,
)
from me2e_compress.simulator.scenarios.scripts.crossers import (
    cyclists_on_exit,
    pedestrians_on_exit,
    walker_behind_van,
    walker_between_cars,
    walkers_on_zebra,
)
from me2e_compress.simulator.scenarios.scripts.flows import crossing_car
from me2e_compress.simulator.scenarios.scripts.leads import (
    blocked_exit,
    hard_brake,
    pull_out,
    queue_cut_in,
)
from me2e_compress.simulator.scenarios.scripts.obstacles import spun_car
from me2e_compress.simulator.traffic.stage import Stage

MOVES = ("left", "right", "ahead")
TURNS = ("left", "right")


def blocked_intersection(stage: Stage) -> None:
    """The way out of a junction is blocked for a while."""
    crossing = junction(stage, stage.choice("move", MOVES))
    stage.play(blocked_exit(stage, crossing))


def dynamic_object_crossing(stage: Stage) -> None:
    """A pedestrian steps out from behind a van."""
    two_way(stage)
    stage.play(walker_behind_van(stage))


def hard_break_route(stage: Stage) -> None:
    """The car ahead brakes hard."""
    stage.play(hard_brake(stage, single_lane(stage)))


def opposite_vehicle_taking_priority(stage: Stage) -> None:
    """A car takes the ego's right of way."""
    stage.play(crossing_car(stage, junction(stage, "ahead")))


def opposite_vehicle_running_red_light(stage: Stage) -> None:
    """A car runs its red light."""
    stage.play(crossing_car(stage, signal_junction(stage, "ahead")))


def parking_cut_in(stage: Stage) -> None:
    """A parked car pulls out."""
    stage.play(pull_out(stage, parking_street(stage)))


def pedestrian_crossing(stage: Stage) -> None:
    """People cross on a crosswalk."""
    zebra_street(stage)
    stage.play(walkers_on_zebra(stage))


def parking_crossing_pedestrian(stage: Stage) -> None:
    """A pedestrian steps out between parked cars."""
    parking_street(stage)
    stage.play(walker_between_cars(stage))


def static_cut_in(stage: Stage) -> None:
    """A car leaves a standing queue."""
    stage.play(queue_cut_in(stage, multilane(stage)))


def vehicle_turning_route(stage: Stage) -> None:
    """Cyclists cross the road that the ego turns into."""
    crossing = junction(stage, stage.choice("move", TURNS))
    stage.play(cyclists_on_exit(stage, crossing))


def vehicle_turning_route_pedestrian(stage: Stage) -> None:
    """Pedestrians cross the road that the ego turns into."""
    crossing = junction(stage, stage.choice("move", TURNS))
    crosswalk_on(stage, crossing, crossing.move)
    stage.play(pedestrians_on_exit(stage, crossing))


def control_loss(stage: Stage) -> None:
    """A slick bend leads to a car across it."""
    bend(stage)
    stage.play(spun_car(stage))
