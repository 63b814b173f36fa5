"""Give_Way: make room."""

from me2e_compress.simulator.scenarios.layouts.streets import (
    multilane,
    two_way_bend,
)
from me2e_compress.simulator.scenarios.scripts.priority import (
    emergency_behind,
    invader,
)
from me2e_compress.simulator.traffic.stage import Stage


def invading_turn(stage: Stage) -> None:
    """An oncoming car cuts the bend."""
    stage.play(invader(stage, two_way_bend(stage)))


def yield_to_emergency_vehicle(stage: Stage) -> None:
    """An emergency vehicle comes from behind."""
    stage.play(emergency_behind(stage, multilane(stage)))
