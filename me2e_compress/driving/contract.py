"""What every evaluator and every driver is."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from me2e_compress.metrics.episode import Episode

Plan = npt.NDArray[np.floating]
"""Six waypoints [6, 2], one every 0.5 s: metres in the ego frame, x forward, y left."""

PLAN_SHAPE = (6, 2)
PLAN_STEP_US = 500_000
CAN_BUS_SIZE = 18


class RouteInfo(Protocol):
    """What a policy is told of the route that it starts on."""

    @property
    def id(self) -> str:
        """Return its name, unique in its set."""
        ...

    @property
    def seed(self) -> int:
        """Return what everything random on it is drawn from."""
        ...


class SceneView(Protocol):
    """Everything there is at one instant, as a simulator lays it out."""

    @property
    def time_us(self) -> int:
        """Return the simulated time since the route began, in microseconds."""
        ...


class WorldView(Protocol):
    """The world behind the scenes; a policy may read it and never steps it."""

    @property
    def route(self) -> RouteInfo:
        """Return the route that is driven."""
        ...


@dataclass(frozen=True, slots=True)
class Observation:
    """What a policy is shown at one decision.

    Attributes:
        time_us: Simulated time since the route began, in microseconds; a model is told
            it in seconds (``timestamp``), so that a recurrent one knows how far apart
            its frames are.
        images: Six cameras, uint8 [6, H, W, 3] in RGB, in the order of the rig;
            None unless the policy asks for images.
        lidar2img: float32 [6, 4, 4], ego frame (x forward, y left, z up, metres) to
            pixels of each camera.
        can_bus: float32 [18], laid out as Bench2Drive's UniAD and VAD agents fill it,
            in a right-handed world (x east, y north): [0:3] metres moved since the
            last decision (world frame), [3:7] quaternion w, x, y, z, [7] speed (m/s),
            [10:13] acceleration (m/s2, ego frame), [13:16] angular velocity (rad/s),
            [16] heading (rad, in [0, 2 pi)), [17] degrees turned since the last
            decision; [0:3] and [17] are zero at the first decision, [8:10] always.
        command: Where the route goes next: 0 left, 1 right, 2 straight, 3 follow the
            lane, 4 change lane to the left, 5 change lane to the right.
        speed_mps: The ego's speed.
        scene: Everything there is, only for a privileged policy.
        world: The world itself, only for a privileged policy, which may read (and
            never step) its path, its road map and what it knows of the actors.
    """

    time_us: int
    images: npt.NDArray[np.uint8] | None
    lidar2img: npt.NDArray[np.float32]
    can_bus: npt.NDArray[np.float32]
    command: int
    speed_mps: float
    scene: SceneView | None = None
    world: WorldView | None = None


class Policy(Protocol):
    """A driver: it is told the route it starts on and then asked for plans."""

    @property
    def needs_images(self) -> bool:
        """Whether the cameras must be rendered for it."""
        ...

    @property
    def privileged(self) -> bool:
        """Whether it may see the scene and the world."""
        ...

    def reset(self, route: RouteInfo) -> None:
        """Forget the last route: recurrent state returns to its first value."""
        ...

    def plan(self, observation: Observation) -> Plan:
        """Return six waypoints [6, 2], metres in the ego frame, every 0.5 s."""
        ...


class Evaluator(Protocol):
    """A source of driven episodes: it says what happened and judges nothing.

    A simulator drives a policy to make them; a results reader finds them in files.
    """

    name: ClassVar[str]

    def episodes(self) -> Iterator[Episode]:
        """Yield each route once, in a fixed order, the same for the same seed."""
        ...
