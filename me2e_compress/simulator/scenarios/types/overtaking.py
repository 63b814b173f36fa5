"""Overtaking: something stands or crawls in the lane; go round it."""

from me2e_compress.simulator.scenarios.layouts.streets import (
    bend,
    multilane,
    parking_street,
    two_way,
)
from me2e_compress.simulator.scenarios.scripts.obstacles import (
    construction,
    crashed_cars,
    neighbours,
    oncoming_cars,
    opening_door,
    parked_car,
    slow_cyclists,
)
from me2e_compress.simulator.traffic.stage import Stage


def accident(stage: Stage) -> None:
    """An accident blocks a road of several lanes."""
    street = multilane(stage)
    stage.play(crashed_cars(stage))
    stage.play(neighbours(stage, street))


def accident_two_ways(stage: Stage) -> None:
    """An accident must be passed through the oncoming lane."""
    street = two_way(stage)
    stage.play(crashed_cars(stage))
    stage.play(oncoming_cars(stage, street))


def construction_obstacle(stage: Stage) -> None:
    """Road works close one of several lanes."""
    street = multilane(stage)
    stage.play(construction(stage))
    stage.play(neighbours(stage, street))


def construction_obstacle_two_ways(stage: Stage) -> None:
    """Road works must be passed through the oncoming lane."""
    street = two_way(stage)
    stage.play(construction(stage))
    stage.play(oncoming_cars(stage, street))


def hazard_at_side_lane(stage: Stage) -> None:
    """Slow cyclists ride in one of several lanes."""
    street = multilane(stage)
    stage.play(slow_cyclists(stage, street))
    stage.play(neighbours(stage, street))


def hazard_at_side_lane_two_ways(stage: Stage) -> None:
    """Slow cyclists must be passed, partly through the oncoming lane."""
    street = two_way(stage)
    stage.play(slow_cyclists(stage, street))
    stage.play(oncoming_cars(stage, street))


def parked_obstacle(stage: Stage) -> None:
    """A vehicle has stopped in a bend of a road of several lanes."""
    bend(stage)
    stage.play(parked_car(stage))


def parked_obstacle_two_ways(stage: Stage) -> None:
    """A stopped vehicle must be passed through the oncoming lane."""
    street = two_way(stage)
    stage.play(parked_car(stage))
    stage.play(oncoming_cars(stage, street))


def vehicle_opens_door_two_ways(stage: Stage) -> None:
    """A parked car opens its door; oncoming traffic leaves little room."""
    street = parking_street(stage)
    stage.play(opening_door(stage))
    stage.play(oncoming_cars(stage, street))
