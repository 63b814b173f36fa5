"""A policy that remembers every frame and what the expert would do there."""

from dataclasses import dataclass, field, replace
from zlib import crc32

import numpy as np

from me2e_compress.driving.contract import Observation, Plan, Policy, RouteInfo
from me2e_compress.evaluators.highway.expert import (
    ExpertDecision,
    Memory,
    ceiling,
    decide,
)
from me2e_compress.evaluators.highway.observe import scene_and_world
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import Scene
from me2e_compress.simulator.world import Phase, World
from me2e_compress.training.episodes.perturb import Perturbation

TURN_US = 2_000_000
"""How long the expert or the student drives before it is drawn again who does."""


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """One frame of the world and the expert's label.

    Attributes:
        scene: What there was.
        phases: The signals on the route.
        command: What the navigator said.
        memory: Of the expert, before its decision.
        decision: Of the expert, whoever drove.
    """

    scene: Scene
    phases: tuple[Phase, ...]
    command: int
    memory: Memory
    decision: ExpertDecision


@dataclass
class RecordingPolicy:
    """The expert decides at every frame; it or the student drives, with noise.

    A student is asked at every frame, also while the expert drives, so that its
    recurrent state never has a gap.

    Args:
        seed: Of noise and turns, together with the id of the route.
        noise: Strength of the noise on the driven plan, see `Perturbation`.
        expert_share: Share of the 2 s turns in which the expert drives.
        student: Who drives in the others; None if the expert always does.

    Attributes:
        frames: Of the present route.
        world: Of the present route; None before its first frame.
    """

    seed: int
    noise: float = 1.0
    expert_share: float = 1.0
    student: Policy | None = None
    privileged: bool = field(default=True, init=False)
    frames: list[LabelledFrame] = field(default_factory=list, init=False)
    world: World | None = field(default=None, init=False)
    top: Floats = field(init=False, repr=False)
    _noise: Perturbation = field(init=False, repr=False)
    _draw: np.random.Generator = field(init=False, repr=False)
    _turns: list[bool] = field(default_factory=list, init=False, repr=False)

    @property
    def needs_images(self) -> bool:
        """Whether the student does."""
        return self.student is not None and self.student.needs_images

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
            self.world, self.top = world, ceiling(world.path)
        memory = self.frames[-1].decision.memory if self.frames else Memory()
        known = world.privileged()
        decision = decide(scene, known, world.path, self.top, memory)
        self.frames.append(
            LabelledFrame(scene, known.phases, observation.command, memory, decision)
        )
        plan = decision.waypoints
        if self.student is not None:
            answer = self.student.plan(replace(observation, scene=None, world=None))
            plan = plan if self._expert_drives(scene.time_us) else answer
        return self._noise.bent(plan, scene.time_us)

    def _expert_drives(self, time_us: int) -> bool:
        while len(self._turns) <= time_us // TURN_US:
            self._turns.append(bool(self._draw.random() < self.expert_share))
        return self._turns[time_us // TURN_US]
