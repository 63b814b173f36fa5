"""Traffic_Signs: obey the lights and signs at the junction."""

from me2e_compress.simulator.scenarios.layouts.crossings import (
    junction,
    signal_junction,
    t_junction,
)
from me2e_compress.simulator.scenarios.scripts.flows import (
    flows_from_both_sides,
    priority_car,
)
from me2e_compress.simulator.scenarios.scripts.leads import queue_at_light
from me2e_compress.simulator.scenarios.scripts.priority import (
    red_light,
    stop_sign,
)
from me2e_compress.simulator.scene import SignalKind, SignalState
from me2e_compress.simulator.traffic.stage import Stage

TURNS = ("left", "right")


def t_junction_turn(stage: Stage) -> None:
    """Turn out of a side road between two flows."""
    crossing = t_junction(stage, stage.choice("move", TURNS))
    stage.play(flows_from_both_sides(stage, crossing))


def vanilla_non_signalized_turn(stage: Stage) -> None:
    """Turn at a give-way sign."""
    move = stage.choice("move", TURNS)
    crossing = junction(stage, move, SignalKind.GIVE_WAY)
    stage.play(priority_car(stage, crossing))


def vanilla_signalized_turn_green(stage: Stage) -> None:
    """Turn at a green light behind a queue that has not started yet.

    Bench2Drive's type has the green light alone, which demands nothing.
    """
    crossing = signal_junction(stage, stage.choice("move", TURNS))
    stage.play(queue_at_light(stage, crossing))


def vanilla_signalized_turn_red(stage: Stage) -> None:
    """Wait at a red light, then turn."""
    move = stage.choice("move", TURNS)
    crossing = signal_junction(stage, move, SignalState.RED)
    stage.play(red_light(stage, crossing))


def vanilla_non_signalized_turn_stopsign(stage: Stage) -> None:
    """Stop at a stop sign, then turn."""
    move = stage.choice("move", TURNS)
    crossing = junction(stage, move, SignalKind.STOP_SIGN)
    stage.play(stop_sign(stage, crossing))
