"""A road, an ego with lag, and actors that keep their course: enough to drive on."""

import math
from dataclasses import dataclass, replace

import numpy as np

from me2e_compress.simulator.bicycle import advance
from me2e_compress.simulator.plane_geometry import (
    Command,
    Floats,
    RoutePath,
    polyline_headings,
    resample,
)
from me2e_compress.simulator.scene import (
    DIMENSIONS,
    Actor,
    ActorKind,
    Control,
    Ego,
    Scene,
    Signal,
)

DT_US = 50_000
LAG_S = (0.2, 0.1)
"""Of acceleration and steering, as in the real world's ego."""


def path_through(
    points: Floats,
    limit_mps: float = 12.0,
    left_m: float = 1.75,
    right_m: float = 1.75,
    oncoming_m: float | None = None,
) -> RoutePath:
    line = resample(points, 1.0)
    n = len(line)
    return RoutePath(
        line,
        polyline_headings(line),
        np.full(n, 3.5),
        np.full(n, limit_mps),
        np.full(n, int(Command.FOLLOW), np.int64),
        n - 61.0,
        np.full(n, left_m),
        np.full(n, right_m),
        np.full(n, left_m if oncoming_m is None else oncoming_m),
    )


def straight(**edges: float) -> RoutePath:
    return path_through(np.array([[0.0, 0.0], [230.0, 0.0]]), **edges)


def circle(radius_m: float, turn_rad: float, run_in_m: float = 30.0) -> RoutePath:
    phi = np.linspace(0.0, turn_rad, 400)[1:]
    bend = radius_m * np.stack([np.sin(phi), 1 - np.cos(phi)], axis=1)
    bend[:, 0] += run_in_m
    out = bend[-1] + np.outer([80.0], [np.cos(turn_rad), np.sin(turn_rad)])
    return path_through(np.vstack([[[0.0, 0.0]], bend, out]))


def ego_at(
    x: float = 5.0,
    y: float = 0.0,
    heading: float = 0.0,
    speed: float = 8.0,
    steering: float = 0.0,
) -> Ego:
    return Ego(x, y, heading, speed, 0.0, 0.0, 0.0, steering, 5.0, 2.0)


def actor(
    x: float,
    y: float = 0.0,
    speed: float = 0.0,
    heading: float = 0.0,
    kind: ActorKind = ActorKind.CAR,
    number: int = 1,
) -> Actor:
    size = DIMENSIONS[kind]
    return Actor(number, kind, x, y, heading, speed, *size, False, 0)


@dataclass
class TinyWorld:
    path: RoutePath
    ego: Ego
    actors: tuple[Actor, ...] = ()
    signals: tuple[Signal, ...] = ()
    time_us: int = 0

    def scene(self) -> Scene:
        return Scene(self.time_us, self.ego, self.actors, self.signals)

    def step(self, control: Control) -> None:
        dt, ego = DT_US / 1e6, self.ego
        follow = [1 - math.exp(-dt / lag) for lag in LAG_S]
        pushed = ego.acceleration_mps2
        pushed += follow[0] * (control.acceleration_mps2 - pushed)
        wheel = ego.steering_rad + follow[1] * (control.steering_rad - ego.steering_rad)
        speed = max(0.0, ego.speed_mps + pushed * dt)
        travel = (ego.speed_mps + speed) / 2 * dt
        x, y, heading = advance(ego.x, ego.y, ego.heading, wheel, travel, ego.length)
        self.ego = Ego(
            *(x, y, heading, speed, pushed, 0.0, 0.0, wheel),
            length=ego.length,
            width=ego.width,
        )
        self.actors = tuple(
            replace(
                a,
                x=a.x + a.speed_mps * dt * math.cos(a.heading),
                y=a.y + a.speed_mps * dt * math.sin(a.heading),
            )
            for a in self.actors
        )
        self.time_us += DT_US
