"""The driving contract: what a policy implements.

A policy is any object with the members of `Policy`; there is no class to derive from.
An evaluator calls ``reset`` before each route and ``plan`` at each decision. The
smallest policy that drives keeps its speed:

    class KeepSpeed:
        needs_images = False
        privileged = False

        def reset(self, route: RouteInfo) -> None:
            pass

        def plan(self, observation: Observation) -> Plan:
            seconds = 0.5 * np.arange(1, 7)
            return np.stack([observation.speed_mps * seconds, np.zeros(6)], axis=1)

Conventions: the ego frame is x forward, y left, z up, metres, its origin on the ground
under the centre of the ego; the world is right-handed, x east, y north, headings in
radians counter-clockwise from east. Times are integer microseconds. When a plan acts is
in `me2e_compress.driving.realtime`, what a decision costs in
`me2e_compress.driving.latency`.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt
from pydantic import Field

from me2e_compress.base.errors import EvaluationError
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.plan_adapter import Trajectory
from me2e_compress.runtime.session import DTYPES, SessionPort

__all__ = [
    "CAN_BUS_SIZE",
    "PLAN_SHAPE",
    "PLAN_STEP_US",
    "Answer",
    "EgoKinematics",
    "HostedPolicy",
    "Observation",
    "PedalsAndWheel",
    "Plan",
    "Policy",
    "RouteInfo",
    "Trajectory",
]

Shape = tuple[int | str | None, ...]
DEFAULT_IMAGE_SIZE = (96, 160)  # rows and columns for a model that takes any size
Triple = tuple[float, float, float]
# An option that is a finite number above 0
Positive: TypeAlias = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Count: TypeAlias = Annotated[int, Field(ge=0)]
# Six waypoints [6, 2], one every 0.5 s: metres in the ego frame of the observation, x
# forward, y left; the first is where the ego is to be 0.5 s later
Plan = npt.NDArray[np.floating]
PLAN_SHAPE = (6, 2)
PLAN_STEP_US = 500_000  # microseconds between two waypoints
CAN_BUS_SIZE = 18
PLAN_TIMES_S = (1 + np.arange(PLAN_SHAPE[0])) * (PLAN_STEP_US / 1e6)  # of waypoints
# Ranges of the controls in `PedalsAndWheel`
RANGES = {"throttle": (0.0, 1.0), "steer": (-1.0, 1.0), "brake": (0.0, 1.0)}


# The ports of a graph: fit of shapes, and conversion of arrays.


def fit_to_port(array: Array, port: SessionPort) -> Array:
    """Return an array with the rank and type of a port."""
    missing = len(port.shape) - array.ndim
    sides = (1,) * missing + array.shape if missing >= 0 else array.shape[-missing:]
    return array.reshape(sides).astype(DTYPES[port.type], copy=False)


def fits(shape: Shape, wanted: Shape) -> bool:
    """Return whether two shapes agree where both are known."""
    return len(shape) == len(wanted) and all(
        not isinstance(side, int) or not isinstance(other, int) or side == other
        for side, other in zip(shape, wanted, strict=True)
    )


@dataclass(frozen=True, slots=True)
class EgoKinematics:
    """Pose and motion of the ego in a right-handed world, x east, y north.

    The heading is in radians counter-clockwise from east; vectors are in the ego frame.
    """

    x: float
    y: float
    heading: float
    speed_mps: float
    acceleration_mps2: Triple
    angular_velocity_radps: Triple


class PedalsAndWheel(NamedTuple):
    """Throttle and brake 0 to 1, steering -1 (left) to 1 (right), as in CARLA."""

    throttle: float
    steer: float
    brake: float


# A policy's decision: waypoints, or controls
Answer: TypeAlias = Plan | Trajectory | PedalsAndWheel


class RouteInfo(Protocol):
    """What a policy may know of a route before it drives it.

    A policy that reads only these two drives in every simulator.
    """

    @property
    def id(self) -> str:
        """Return the route's name, unique in its set."""
        ...

    @property
    def seed(self) -> int:
        """Return the seed of all randomness on the route, the policy's included."""
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
            in a right-handed world (x east, y north): [0:3] metres moved since the last
            decision (world frame), [3:7] quaternion w, x, y, z, [7] speed (m/s),
            [10:13] acceleration (m/s2, ego frame), [13:16] angular velocity (rad/s),
            [16] heading (rad, in [0, 2 pi)), [17] degrees turned since the last
            decision; [0:3] and [17] are zero at the first decision, [8:10] always.
        command: Where the route goes next: 0 left, 1 right, 2 straight, 3 follow the
            lane, 4 change lane to the left, 5 change lane to the right.
        speed_mps: The ego's speed.
        scene: Ground truth at this instant, in the simulator's own type (highway-env:
            `me2e_compress.simulator.scene.Scene`); None unless `Policy.privileged`.
        world: The simulated world, likewise (of highway-env a
            :class:`~me2e_compress.simulator.world.World`); never to be stepped.
        motion: The ego's pose and motion from its own sensors; None if the simulator
            does not provide it. The CAN bus alone has no absolute position.
        target_points: float32 [2, 2], the next node of the route's sparse plan and the
            one after it, metres in the ego frame; None if the simulator has none. Nodes
            are at most 50 m apart, and the next is at least 4 m ahead, as in the route
            planner of Bench2Drive's agents.
    """

    time_us: int
    images: npt.NDArray[np.uint8] | None
    lidar2img: npt.NDArray[np.float32]
    can_bus: npt.NDArray[np.float32]
    command: int
    speed_mps: float
    scene: object | None = None
    world: object | None = None
    motion: EgoKinematics | None = None
    target_points: npt.NDArray[np.float32] | None = None


class Policy(Protocol):
    """A driver: maps observations to plans or controls, one route after the other.

    One object drives many routes in one process, never two at the same time. An
    exception, or an answer that is not finite, out of range or of another shape, ends
    that route as failed (`Ending.POLICY_FAILED`); the other routes go on.
    """

    @property
    def needs_images(self) -> bool:
        """Whether the cameras must be rendered."""
        ...

    @property
    def privileged(self) -> bool:
        """Whether it gets ground truth: `Observation.scene` and `Observation.world`."""
        ...

    def reset(self, route: RouteInfo) -> None:
        """Prepare for a route: reset recurrent state to its initial value.

        The same observations must then give the same answers, whatever came before.
        """

    def plan(self, observation: Observation) -> Answer:
        """Return the plan or the controls for one observation, once per decision.

        Plans are six waypoints [6, 2], metres in the ego frame, every 0.5 s, or a
        `Trajectory` of waypoints with their times. Numbers are floating point and
        finite. The run time counts only where latency is measured.
        """
        ...


@runtime_checkable
class HostedPolicy(Policy, Protocol):
    """A policy that runs a stage on the host after its network, for the latest plan."""

    @property
    def host_iterations(self) -> int:
        """Return the solver's iterations; 0 if there was nothing to do."""
        ...

    @property
    def host_cells(self) -> int:
        """Return the number of occupied cells taken into account."""
        ...


# Check a policy's answer, and bring it into one form.


def check_answer(answer: object) -> Trajectory | PedalsAndWheel:
    """Return a policy's answer, a plan with the times of its waypoints.

    Raises:
        EvaluationError: It has another form or shape, is not finite, or is out of
            range.
    """
    # Controls have their ranges
    if isinstance(answer, PedalsAndWheel):
        for name, (low, high) in RANGES.items():
            value = getattr(answer, name)
            if not low <= value <= high:  # which NaN is not either
                raise EvaluationError(
                    f"{name} is {value:g}, it must be from {low:g} to {high:g}"
                )
        return answer
    # Waypoints with their times
    if isinstance(answer, Trajectory):
        return Trajectory(_finite(answer.points), np.asarray(answer.times_s))
    # An array of six waypoints
    if not isinstance(answer, np.ndarray) or answer.dtype.kind != "f":
        kind = type(answer).__name__
        if isinstance(answer, np.ndarray):
            kind = f"an array of {answer.dtype}"
        raise EvaluationError(f"the plan is not a float array but {kind}")
    if answer.shape != PLAN_SHAPE:
        raise EvaluationError(
            f"the plan has shape {list(answer.shape)}, it must be {list(PLAN_SHAPE)}"
        )
    return Trajectory(_finite(answer), PLAN_TIMES_S)


def with_times(plan: Plan | Trajectory) -> Trajectory:
    """Return a plan with the times of its waypoints."""
    return plan if isinstance(plan, Trajectory) else Trajectory(plan, PLAN_TIMES_S)


def six_waypoints(answer: object) -> npt.NDArray[np.float64]:
    """Return a plan as six waypoints every 0.5 s, interpolated if need be."""
    control = check_answer(answer)
    if isinstance(control, PedalsAndWheel):
        raise EvaluationError("the policy answers controls: there is no plan")
    if np.array_equal(control.times_s, PLAN_TIMES_S):
        return np.asarray(control.points, np.float64)
    return control.at(PLAN_TIMES_S)


def _finite(points: Plan) -> Plan:
    if not np.isfinite(points).all():
        raise EvaluationError("the plan is not finite")
    return points.astype(np.float64)
