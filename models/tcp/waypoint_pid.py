"""Waypoints to controls: the PID agents of Bench2Drive."""

import math
from collections import deque

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import PedalsAndWheel, Plan, with_times
from me2e_compress.runtime.plan_adapter import Trajectory

Place = tuple[float, float]
"""A position: metres to the right and forward."""


class PidOptions(BaseModel):
    """Gains and limits.

    Attributes:
        turn_kp: Gain of the angle to the aim, a quarter turn being 1.
        turn_ki: Gain of the angle's mean over the window.
        turn_kd: Gain of the angle's change since the last decision.
        turn_window: Length in decisions; at 20 Hz, 40 are 2 s.
        speed_kp: Gain of the missing speed, m/s.
        speed_ki: Gain of its mean over the window.
        speed_kd: Gain of its change since the last decision.
        speed_window: Length in decisions.
        max_throttle: Upper limit.
        brake_speed_mps: A plan slower than this brakes.
        brake_ratio: So does a plan that is slower than the ego by this factor.
        clip_delta_mps: Upper limit of the missing speed.
        aim_m: The aim is the waypoint whose midpoint with the next one is nearest to
            this distance.
        angle_threshold: The route's node replaces the waypoint if its angle differs
            from that of the plan's end by more than this, in quarter turns,
        node_within_m: and it is less far ahead than this; or if its angle is the
            smaller one.
        coast_above_mps: Above this speed the throttle is released; UniAD's agent has 5,
            VAD's no such limit.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    turn_kp: float = 0.75
    turn_ki: float = 0.75
    turn_kd: float = 0.3
    turn_window: int = Field(default=40, ge=2, le=4000)
    speed_kp: float = 5.0
    speed_ki: float = 0.5
    speed_kd: float = 1.0
    speed_window: int = Field(default=40, ge=2, le=4000)
    max_throttle: float = Field(default=0.75, ge=0.0, le=1.0)
    brake_speed_mps: float = 0.4
    brake_ratio: float = 1.1
    clip_delta_mps: float = 0.25
    aim_m: float = 4.0
    angle_threshold: float = 0.3
    node_within_m: float = 10.0
    coast_above_mps: float = Field(default=math.inf, gt=0.0, allow_inf_nan=True)


class WaypointPid:
    """Follows one plan after the other; its windows count decisions, not seconds."""

    def __init__(self, options: PidOptions) -> None:
        self.options = options
        self._angles = deque([0.0] * options.turn_window, options.turn_window)
        self._misses = deque([0.0] * options.speed_window, options.speed_window)

    def control(
        self, plan: Plan | Trajectory, speed_mps: float, node: Place
    ) -> PedalsAndWheel:
        """Return the controls that follow a plan of two waypoints or more.

        ``node`` is the next node of the route, metres to the right and forward.
        """
        # mean speed of the plan, its waypoints as (right, forward)
        asked, trajectory = self.options, with_times(plan)
        forward, left = trajectory.points.T
        waypoints = np.stack([-left, forward], axis=1).astype(np.float64)
        if len(waypoints) < 2:
            raise EvaluationError("a plan of one waypoint cannot be followed by PID")
        steps = np.hypot(*np.diff(waypoints, axis=0).T)
        wanted_mps = float(np.mean(steps) / np.mean(np.diff(trajectory.times_s)))
        # the waypoint aimed at
        middles = (waypoints[1:] + waypoints[:-1]) / 2
        aim = int(np.argmin(np.abs(np.hypot(*middles.T) - asked.aim_m)))
        angle = _quarter_turns(*waypoints[aim])
        # follow the route's node instead where the plan's end strays from it
        at_end = _quarter_turns(*(waypoints[-1] - waypoints[-2]))
        to_node = _quarter_turns(*node)
        outlier = abs(to_node - at_end) > asked.angle_threshold
        near = node[1] < asked.node_within_m
        follow = abs(to_node) < abs(angle) or (outlier and near)
        self._angles.append(to_node if follow else angle)
        # PID over the window
        turns = asked.turn_kp, asked.turn_ki, asked.turn_kd
        steer = min(max(_pid(self._angles, *turns), -1.0), 1.0)
        # throttle towards that speed; brake where the plan is slow or the ego too fast
        missing = min(max(wanted_mps - speed_mps, 0.0), asked.clip_delta_mps)
        self._misses.append(missing)
        gains = asked.speed_kp, asked.speed_ki, asked.speed_kd
        throttle = min(max(_pid(self._misses, *gains), 0.0), asked.max_throttle)
        too_fast = speed_mps > asked.brake_ratio * wanted_mps
        if wanted_mps < asked.brake_speed_mps or too_fast:
            return PedalsAndWheel(0.0, steer, 1.0)
        coasting = speed_mps > asked.coast_above_mps
        return PedalsAndWheel(0.0 if coasting else throttle, steer, 0.0)


def _quarter_turns(right: float, forward: float) -> float:
    """Return the angle from straight ahead to the right; up to 3 behind to the left."""
    return 1.0 - math.atan2(forward, right) / (math.pi / 2)


def _pid(window: deque[float], kp: float, ki: float, kd: float) -> float:
    change = window[-1] - window[-2]
    return kp * window[-1] + ki * sum(window) / len(window) + kd * change
