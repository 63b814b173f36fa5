"""A policy that records every frame with the expert's decision, and perturbs plans.

Noise on the driven plan makes the data show how to return to the route.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Self
from zlib import crc32

import numpy as np

from me2e_compress.driving.contract import (
    PLAN_SHAPE,
    PLAN_TIMES_S,
    Observation,
    Plan,
    Policy,
    RouteInfo,
    six_waypoints,
)
from me2e_compress.evaluators.highway.observe import ObservationBuilder, cameras_of
from me2e_compress.runtime.plan_adapter import Trajectory
from me2e_compress.simulator.camera_rig import CameraRig
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import Scene
from me2e_compress.simulator.world import World
from models.driver.expert.expert_policy import (
    ExpertDecision,
    Memory,
    ceiling,
    decide,
)
from models.driver.expert.privileged import Phase, privileged, scene_and_world
from models.driver.expert.visibility import seen

BURST_S = (0.4, 1.5)
PAUSE_S = (0.9, 4.8)
"""Between two bursts; with `BURST_S` a quarter of the time is noise."""
DRIFT_M = 1.5
"""Largest sideways shift of the last waypoint."""
DRIFT_TRAVEL_M = 6.0
"""A plan that goes less far than this drifts less: a stop does not creep."""
TURN_RAD = float(np.deg2rad(8.0))
SPEED = (0.5, 1.3)
GROWTH = (1.0 + np.arange(PLAN_SHAPE[0])) / PLAN_SHAPE[0]


@dataclass(frozen=True)
class PlanNoise:
    """A change of a plan.

    Attributes:
        drift_m: Metres to the left at the last waypoint, growing with time.
        turn_rad: How far the plan is turned to the left.
        speed: Factor on its length.
    """

    drift_m: float = 0.0
    turn_rad: float = 0.0
    speed: float = 1.0

    @classmethod
    def draw(cls, rng: np.random.Generator, strength: float) -> Self:
        """Draw a drift, a turn or a change of speed, each as likely, uniformly."""
        kind, side = rng.integers(3), rng.uniform(-1.0, 1.0)
        if kind == 0:
            return cls(drift_m=strength * DRIFT_M * side)
        if kind == 1:
            return cls(turn_rad=strength * TURN_RAD * side)
        change = strength * (rng.uniform(*SPEED) - 1.0)
        return cls(speed=max(1.0 + change, 0.0))

    def apply(self, plan: Plan) -> Plan:
        """Return the changed plan; [6, 2] metres in the ego frame, as the given one."""
        cos, sin = np.cos(self.turn_rad), np.sin(self.turn_rad)
        turned = self.speed * plan @ np.array([[cos, sin], [-sin, cos]])
        share = min(float(np.hypot(*plan[-1])) / DRIFT_TRAVEL_M, 1.0)
        turned[:, 1] += self.drift_m * share * GROWTH
        return np.asarray(turned)


@dataclass(frozen=True)
class Burst:
    """Noise and when it is in force."""

    begin_us: int
    end_us: int
    noise: PlanNoise


def bursts(rng: np.random.Generator, strength: float) -> Iterator[Burst]:
    """Yield bursts in order of time, without end."""
    at = 0.0
    while True:
        begin = at + rng.uniform(*PAUSE_S)
        at = begin + rng.uniform(*BURST_S)
        yield Burst(int(begin * 1e6), int(at * 1e6), PlanNoise.draw(rng, strength))


@dataclass
class Perturbation:
    """The noise of one route.

    Args:
        rng: Where the noise comes from.
        strength: Scales it; 0 leaves every plan as it is.
    """

    rng: np.random.Generator
    strength: float
    _coming: Iterator[Burst] = field(init=False, repr=False)
    _burst: Burst = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Draw the first burst."""
        self._coming = bursts(self.rng, self.strength)
        self._burst = next(self._coming)

    def apply(self, plan: Plan, time_us: int) -> Plan:
        """Return the plan that is driven at a time; times must not decrease."""
        while time_us >= self._burst.end_us:
            self._burst = next(self._coming)
        if self.strength == 0.0 or time_us < self._burst.begin_us:
            return plan
        return self._burst.noise.apply(plan)


TURN_US = 2_000_000
"""How long the expert or the student drives before it is drawn again who does."""


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """One frame of the world and the expert's label.

    Attributes:
        scene: What there was.
        phases: The signals on the route.
        command: The navigation command.
        memory: Of the expert, before its decision.
        decision: Of the expert, even if the student drove.
    """

    scene: Scene
    phases: tuple[Phase, ...]
    command: int
    memory: Memory
    decision: ExpertDecision


@dataclass(frozen=True, eq=False)
class PlanInForce:
    """A plan that is driven until the next one is made.

    Attributes:
        made: When and where it was made.
        plan: [6, 2] metres in the ego frame of then.
    """

    made: Scene
    plan: Plan

    def seen_at(self, now: Scene) -> Plan:
        """Return its waypoints of 0.5 to 3 s from now, in the ego frame of now."""
        since_s = (now.time_us - self.made.time_us) / 1e6
        if since_s == 0.0:
            return self.plan
        ahead = Trajectory(self.plan, PLAN_TIMES_S).at(PLAN_TIMES_S + since_s)
        return now.ego.seen(*self.made.ego.placed(ahead).T)


@dataclass
class RecordingPolicy:
    """The expert decides at every frame; it or the student drives, with noise.

    The student plans at every stored sample, as it learns from them, also while the
    expert drives, so that its recurrent state has no gaps; between two of them its
    last plan is driven on.

    Args:
        seed: Of noise and turns, together with the id of the route.
        noise: Strength of the noise on the driven plan, see `Perturbation`.
        expert_share: Share of the 2 s turns in which the expert drives.
        student: Who drives in the others; None if the expert always does.
        every: Frames between two stored samples.
        rig: The student's cameras.

    Attributes:
        frames: Of the present route.
        world: Of the present route; None before its first frame.
    """

    seed: int
    noise: float = 1.0
    expert_share: float = 1.0
    student: Policy | None = None
    every: int = 1
    rig: CameraRig = field(default_factory=CameraRig)
    needs_images: bool = field(default=False, init=False)
    privileged: bool = field(default=True, init=False)
    frames: list[LabelledFrame] = field(default_factory=list, init=False)
    world: World | None = field(default=None, init=False)
    top: Floats = field(init=False, repr=False)
    _noise: Perturbation = field(init=False, repr=False)
    _draw: np.random.Generator = field(init=False, repr=False)
    _turns: list[bool] = field(default_factory=list, init=False, repr=False)
    _observer: ObservationBuilder = field(init=False, repr=False)
    _planned: PlanInForce = field(init=False, repr=False)

    def reset(self, route: RouteInfo) -> None:
        """Begin a route."""
        words = [self.seed, crc32(route.id.encode())]
        self._noise = Perturbation(np.random.default_rng(words), self.noise)
        self._draw = np.random.default_rng([*words, 1])
        self.frames, self._turns, self.world = [], [], None
        if self.student is not None:
            self.student.reset(route)

    def plan(self, observation: Observation) -> Plan:
        """Keep the expert's decision and return what is driven."""
        scene, world = scene_and_world(observation, "recording")
        if self.world is None:
            self._begin(world)
        memory = self.frames[-1].decision.memory if self.frames else Memory()
        shown = seen(scene)
        known = privileged(world, [actor.id for actor in shown.actors])
        decision = decide(shown, known, world.path, self.top, memory)
        self.frames.append(
            LabelledFrame(scene, known.phases, observation.command, memory, decision)
        )
        plan = decision.waypoints
        if self.student is not None:
            if (len(self.frames) - 1) % self.every == 0:
                answer = self.student.plan(self._observer.observe(scene))
                self._planned = PlanInForce(scene, six_waypoints(answer))
            if not self._expert_drives(scene.time_us):
                plan = self._planned.seen_at(scene)
        return self._noise.apply(plan, scene.time_us)

    def _begin(self, world: World) -> None:
        self.world, self.top = world, ceiling(world.path)
        if self.student is not None:
            shown = cameras_of(world, self.rig) if self.student.needs_images else None
            self._observer = ObservationBuilder(world, self.student, self.rig, shown)

    def _expert_drives(self, time_us: int) -> bool:
        while len(self._turns) <= time_us // TURN_US:
            self._turns.append(bool(self._draw.random() < self.expert_share))
        return self._turns[time_us // TURN_US]
