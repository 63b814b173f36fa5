"""The driving contract: what a policy and an evaluator implement.

A policy is any object with the members of `Policy`; there is no class to derive from.
An evaluator calls ``reset`` before each route and ``plan`` at each decision. The least
that drives keeps its speed:

    class KeepSpeed:
        needs_images = False
        privileged = False

        def reset(self, route: RouteInfo) -> None:
            pass

        def plan(self, observation: Observation) -> Plan:
            seconds = 0.5 * np.arange(1, 7)
            return np.stack([observation.speed_mps * seconds, np.zeros(6)], axis=1)

An evaluator is any object with the members of `Evaluator`: it yields one `Episode` a
route, and `me2e_compress.metrics` scores them.

A policy answers waypoints, six every 0.5 s as an array, any others as a `Trajectory`
with their times; or `PedalsAndWheel`, and then there is no plan.

Conventions: the ego frame is x forward, y left, z up, metres, its origin on the ground
under the centre of the ego; the world is right-handed, x east, y north, headings in
radians counter-clockwise from east. Times are integer microseconds.

When a plan acts, and which frames are decisions, says `me2e_compress.driving.realtime`;
what a decision costs, `me2e_compress.driving.latency`; how a policy gets a name,
`me2e_compress.driving.policies`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.ego_kinematics import EgoKinematics
from me2e_compress.metrics.episode import Episode
from me2e_compress.runtime.trajectory import Trajectory

__all__ = [
    "CAN_BUS_SIZE",
    "PLAN_SHAPE",
    "PLAN_STEP_US",
    "Answer",
    "Evaluator",
    "HostedPolicy",
    "Observation",
    "PedalsAndWheel",
    "Plan",
    "Policy",
    "RouteInfo",
    "SceneView",
    "SizedEvaluator",
    "Trajectory",
    "WorldView",
]

Plan = npt.NDArray[np.floating]
"""Six waypoints [6, 2], one every 0.5 s: metres in the ego frame of the observation, x
forward, y left; the first is where the ego is to be 0.5 s later."""

PLAN_SHAPE = (6, 2)
PLAN_STEP_US = 500_000
"""Microseconds between two waypoints."""
CAN_BUS_SIZE = 18


class PedalsAndWheel(NamedTuple):
    """Throttle and brake 0 to 1, steering -1 (left) to 1 (right), as in CARLA."""

    throttle: float
    steer: float
    brake: float


Answer: TypeAlias = Plan | Trajectory | PedalsAndWheel
"""What a policy decides: waypoints, or controls."""


class RouteInfo(Protocol):
    """What a policy may know of a route before it drives it.

    A simulator passes its own route, which has more members; a policy that reads only
    these two drives in every simulator.
    """

    @property
    def id(self) -> str:
        """Return the route's name, unique in its set."""
        ...

    @property
    def seed(self) -> int:
        """Return the seed of everything random on the route, the policy's own too."""
        ...


class SceneView(Protocol):
    """A snapshot of everything at one instant: ground truth for privileged policies.

    A simulator passes its own scene (highway-env: `me2e_compress.simulator.scene.Scene`
    with ego, actors and signals). A policy that reads more than the time is written for
    one simulator and checks the type first.
    """

    @property
    def time_us(self) -> int:
        """Return the simulated time since the route began, in microseconds."""
        ...


class WorldView(Protocol):
    """The simulated world itself: ground truth for privileged policies, read only.

    A simulator passes its own world (highway-env:
    `me2e_compress.simulator.world.World` with path, road map and intents). A policy may
    read it and must never step it.
    """

    @property
    def route(self) -> RouteInfo:
        """Return the route that is driven."""
        ...


@dataclass(frozen=True, slots=True)
class Observation:
    """What a policy gets at one decision.

    Attributes:
        time_us: Simulated time since the route began, in microseconds. An ONNX model
            gets it in seconds (``timestamp``): decisions are not evenly spaced where
            latency skips some.
        images: Six cameras, uint8 [6, H, W, 3] in RGB, in the order front, front left,
            front right, back, back left, back right; None unless `Policy.needs_images`.
        lidar2img: float32 [6, 4, 4], ego frame to pixels of each camera: for a point p,
            M @ (p, 1) = (u * depth, v * depth, depth, 1).
        can_bus: float32 [18], laid out as Bench2Drive's UniAD and VAD agents fill it,
            in a right-handed world (x east, y north): [0:3] metres moved since the
            last decision (world frame), [3:7] quaternion w, x, y, z, [7] speed (m/s),
            [10:13] acceleration (m/s2, ego frame), [13:16] angular velocity (rad/s),
            [16] heading (rad, in [0, 2 pi)), [17] degrees turned since the last
            decision; [0:3] and [17] are zero at the first decision, [8:10] always.
        command: Where the route goes next: 0 left, 1 right, 2 straight, 3 follow the
            lane, 4 change lane to the left, 5 change lane to the right.
        speed_mps: The ego's speed.
        scene: Ground truth at this instant; None unless `Policy.privileged`.
        world: The world itself; None unless `Policy.privileged`.
        motion: Where the ego is and how it moves, as its own sensors tell; None where
            a simulator does not say. The CAN bus alone has no place.
        target_points: float32 [2, 2], the next node of the route's sparse plan and the
            one after it, metres in the ego frame; None where a simulator has none.
            Nodes are at most 50 m apart, and the next is at least 4 m ahead, as in the
            route planner of Bench2Drive's agents.
    """

    time_us: int
    images: npt.NDArray[np.uint8] | None
    lidar2img: npt.NDArray[np.float32]
    can_bus: npt.NDArray[np.float32]
    command: int
    speed_mps: float
    scene: SceneView | None = None
    world: WorldView | None = None
    motion: EgoKinematics | None = None
    target_points: npt.NDArray[np.float32] | None = None


class Policy(Protocol):
    """A driver: maps observations to plans or controls, one route after the other.

    One object drives many routes in one process, never two at the same time. What it
    raises, or an answer of another shape, out of its range or not finite, ends that
    route as failed (`Ending.POLICY_FAILED`); the other routes go on.
    """

    @property
    def needs_images(self) -> bool:
        """Whether the cameras must be rendered for it."""
        ...

    @property
    def privileged(self) -> bool:
        """Whether it gets ground truth: `Observation.scene` and `Observation.world`."""
        ...

    def reset(self, route: RouteInfo) -> None:
        """Prepare for a route: recurrent state returns to its initial value.

        After it, the same observations must give the same answers, whatever was driven
        before.

        Args:
            route: The route that starts.
        """
        ...

    def plan(self, observation: Observation) -> Answer:
        """Return the plan for one observation, or the controls.

        Called once a decision, in order of time. The time that it takes counts only
        where latency is measured.

        Args:
            observation: What the policy gets at this decision.

        Returns:
            Six waypoints [6, 2], metres in the ego frame, every 0.5 s; others with
            their times, a `Trajectory`; or controls. Floating point, finite.
        """
        ...


@runtime_checkable
class HostedPolicy(Policy, Protocol):
    """A policy with a stage beside its network, on the host, that tells its work.

    Both are of the latest plan: a latency may be charged for them
    (`me2e_compress.driving.layered_latency.HostStageLatency`).
    """

    @property
    def host_iterations(self) -> int:
        """Return the iterations of its solver; 0 where it had nothing to do."""
        ...

    @property
    def host_cells(self) -> int:
        """Return the occupied cells that it took into account."""
        ...


class Evaluator(Protocol):
    """A source of driven episodes: it reports what happened and scores nothing.

    A simulator drives a policy to make them; a reader of results finds them in files.

    Attributes:
        name: What the command line and studies call it.
    """

    name: ClassVar[str]

    def episodes(self) -> Iterator[Episode]:
        """Yield one episode a route, in a fixed order, the same for the same seed.

        Raises:
            EvaluationError: It cannot go on: one line that names the culprit.
        """
        ...


@runtime_checkable
class SizedEvaluator(Evaluator, Protocol):
    """An evaluator whose whole set has more routes than it may yield."""

    @property
    def set_size(self) -> int:
        """How many routes the whole set has: fewer are a partial result."""
        ...
