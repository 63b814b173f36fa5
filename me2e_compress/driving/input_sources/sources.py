"""Input sources of the ego: its motion and its past, in the model's axes; its pose."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import Count, Positive
from me2e_compress.driving.input_sources import InputSource, Observed
from me2e_compress.runtime.frames import Array

Quantity = Literal["x", "y", "heading", "speed"]
MOST = 1000  # steps or classes of an input: more is a slip, and memory without end
Six = tuple[int, int, int, int, int, int]
LARGEST = 1e18  # the largest value: within int64
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Speed(InputSource):
    """The speed, m/s: []."""

    name: ClassVar[str] = "speed"

    def value(self, observed: Observed) -> Array:
        """Return float64 []."""
        return np.asarray(float(observed.observation.speed_mps))


@dataclass(frozen=True)
class Velocity(InputSource):
    """The speed as a vector along the vehicle, m/s: [2]."""

    name: ClassVar[str] = "velocity"

    def value(self, observed: Observed) -> Array:
        """Return float64 [2]."""
        return observed.turned([observed.observation.speed_mps, 0.0])


@dataclass(frozen=True)
class Acceleration(InputSource):
    """The acceleration, m/s2: [2], or [3].

    Attributes:
        vertical: Add the vertical component.
    """

    name: ClassVar[str] = "acceleration"
    vertical: bool = False

    def value(self, observed: Observed) -> Array:
        """Return float64 [2 or 3]."""
        forward, left, up = observed.observation.can_bus[10:13]
        level = observed.turned([forward, left])
        return np.append(level, up) if self.vertical else level


@dataclass(frozen=True)
class YawRate(InputSource):
    """The rate of turning, rad/s, counter-clockwise in right-handed axes: []."""

    name: ClassVar[str] = "yaw-rate"

    def value(self, observed: Observed) -> Array:
        """Return float64 []."""
        return np.asarray(observed.angle(float(observed.observation.can_bus[15])))


@dataclass(frozen=True)
class Past(InputSource):
    """States of the ego before now: [steps, quantities], the oldest first.

    Positions and headings are relative to the present pose, metres and radians in the
    model's axes; the present is not among them. Between decisions they are
    interpolated; before a route's first decision the ego stood still.

    Attributes:
        steps: How many states.
        spacing_s: Seconds from one to the next, the last being that long ago.
        quantities: Columns of the result: x, y, heading, speed (m/s).
        deltas: Changes from each state to the one after it, the last one to now.
        newest_first: Reverse the order.
    """

    name: ClassVar[str] = "past"
    steps: Annotated[int, Field(ge=1, le=MOST)]
    spacing_s: Positive = 0.5
    quantities: tuple[Quantity, ...] = ("x", "y")
    deltas: bool = False
    newest_first: bool = False

    def value(self, observed: Observed) -> Array:
        """Return float64 [steps, quantities]."""
        # the ego's states, the present one last
        now = observed.motion
        back = 1e6 * self.spacing_s * np.arange(self.steps, -1, -1)
        states = observed.track.at(observed.observation.time_us - back)
        # relative to the present pose, in the model's axes
        states[:, :3] -= (now.x, now.y, states[-1, 2])
        cos, sin = np.cos(now.heading), np.sin(now.heading)
        in_ego = states[:, :2] @ np.array([[cos, -sin], [sin, cos]])
        states[:, :2] = observed.turned(in_ego)
        states[:, 2] *= -1.0 if observed.axes.is_left_handed else 1.0
        past = np.diff(states, axis=0) if self.deltas else states[:-1]
        columns = [("x", "y", "heading", "speed").index(q) for q in self.quantities]
        return past[:: -1 if self.newest_first else 1, columns]


@dataclass(frozen=True)
class LidarToGlobalRotation(InputSource):
    """UniAD's ``l2g_r_mat``: [3, 3].

    From the model's ground frame, whose origin is under the centre of the ego, to the
    world, x east, y north.

    Attributes:
        transposed: For row vectors, p @ R + t, as UniAD of nuScenes takes it; else for
            column vectors, R @ p + t.
    """

    name: ClassVar[str] = "l2g-rotation"
    transposed: bool = True

    def value(self, observed: Observed) -> Array:
        """Return float64 [3, 3]."""
        cos, sin = math.cos(observed.motion.heading), math.sin(observed.motion.heading)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        rotation = turn @ observed.axes.to_ego
        return rotation.T if self.transposed else rotation


@dataclass(frozen=True)
class LidarToGlobalTranslation(InputSource):
    """UniAD's ``l2g_t``, metres: [3]."""

    name: ClassVar[str] = "l2g-translation"

    def value(self, observed: Observed) -> Array:
        """Return float64 [3]."""
        return np.array([observed.motion.x, observed.motion.y, 0.0])


@dataclass(frozen=True)
class CanBus(InputSource):
    """UniAD's and VAD's 18 numbers: [18].

    ``bench2drive``, as in the contract, has the speed at 7, acceleration at 10 and
    angular rates at 13. ``nuscenes`` (BEVFormer's ``_get_can_bus_info``) has
    acceleration at 7, angular rates at 10 and the velocity at 13. Both have the
    position at 0, the quaternion at 3, the heading in radians at 16, in degrees at 17.

    Attributes:
        layout: Which layout.
        absolute: Absolute position and degrees, for a model that compares them with
            those of its last frame itself; else the change since the last decision.
    """

    name: ClassVar[str] = "can-bus"
    layout: Literal["bench2drive", "nuscenes"] = "bench2drive"
    absolute: bool = False

    def value(self, observed: Observed) -> Array:
        """Return float32 [18]."""
        ours = observed.observation.can_bus
        bus = np.array(ours, np.float32)
        if self.layout == "nuscenes":
            bus[7:10], bus[10:13] = ours[10:13], ours[13:16]
            bus[13:16] = ours[7], 0.0, 0.0
        if self.absolute:
            bus[0:2] = observed.motion.x, observed.motion.y
            bus[17] = math.degrees(bus[16])
        return bus


# Input sources of the route ahead, of time, and of constants.


@dataclass(frozen=True)
class NavigationCommand(InputSource):
    """The command, a number [] or one-hot [classes].

    Attributes:
        numbers: The model's number of left, right, straight, follow the lane, change to
            the left and change to the right. The default is Bench2Drive's (CARLA's
            RoadOption less one); nuScenes' VAD, which has right, left and straight
            alone, is [1, 0, 2, 2, 1, 0].
        one_hot: How many classes the vector has; 0 gives the number itself.
    """

    name: ClassVar[str] = "command"
    numbers: Six = (0, 1, 2, 3, 4, 5)
    one_hot: int = 0

    def __post_init__(self) -> None:
        fit = 0 <= min(self.numbers) <= max(self.numbers) < self.one_hot <= MOST
        if self.one_hot and not fit:
            numbers = list(self.numbers)
            classes = f"one_hot = {self.one_hot} classes, of {MOST} at most"
            raise EvaluationError(f"command: numbers {numbers} do not fit {classes}")

    def value(self, observed: Observed) -> Array:
        """Return int64 [], or float32 [classes]."""
        number = self.numbers[observed.observation.command]
        if not self.one_hot:
            return np.asarray(number, np.int64)
        return np.asarray(np.eye(self.one_hot)[number], np.float32)


@dataclass(frozen=True)
class TargetPoint(InputSource):
    """A node of the route's sparse plan, metres in the model's axes: [2].

    Attributes:
        which: The next node, ``near``, or the one after it, ``far``.
    """

    name: ClassVar[str] = "target-point"
    which: Literal["near", "far"] = "near"

    def value(self, observed: Observed) -> Array:
        """Return float64 [2]."""
        points = observed.observation.target_points
        if points is None:
            raise EvaluationError(
                "the adapter asks for a target point, and the observation has none"
            )
        return observed.turned(points[0 if self.which == "near" else 1])


@dataclass(frozen=True)
class Timestamp(InputSource):
    """Time since the route began: [].

    Attributes:
        unit: Seconds, or whole microseconds (nuScenes').
    """

    name: ClassVar[str] = "timestamp"
    unit: Literal["s", "us"] = "s"

    def value(self, observed: Observed) -> Array:
        """Return float64 [], or int64 []."""
        time_us = observed.observation.time_us
        if self.unit == "us":
            return np.asarray(time_us, np.int64)
        return np.asarray(time_us / 1e6)


@dataclass(frozen=True)
class UsePrevious(InputSource):
    """0 at the first decision of a route, then 1 (UniAD's ``use_prev_bev``): []."""

    name: ClassVar[str] = "use-previous"

    def value(self, observed: Observed) -> Array:
        """Return int64 []."""
        return np.asarray(int(observed.track.decisions > 1), np.int64)


@dataclass(frozen=True)
class ConstantInput(InputSource):
    """The same numbers at every decision.

    Attributes:
        values: The numbers, row by row.
        shape: Their shape; empty for one row of them.
    """

    name: ClassVar[str] = "constant"
    values: tuple[Annotated[float, Field(ge=-LARGEST, le=LARGEST)], ...]
    shape: tuple[Count, ...] = ()

    def __post_init__(self) -> None:
        sides = self.shape or (len(self.values),)
        if math.prod(sides) != len(self.values):
            raise EvaluationError(
                f"constant: {len(self.values)} values have no shape {list(self.shape)}"
            )

    def value(self, observed: Observed) -> Array:
        """Return float64, or int64 where all values are whole numbers."""
        whole = all(value.is_integer() for value in self.values)
        array = np.array(self.values, np.int64 if whole else np.float64)
        return array.reshape(self.shape) if self.shape else array


# Camera poses and projections, for the pictures that the model sees.


@dataclass(frozen=True)
class LidarToImage(InputSource):
    """The model's ground frame to pixels, camera by camera: [cameras, 4, 4].

    Attributes:
        images: The image input whose pixels they are; empty where there is one.
    """

    name: ClassVar[str] = "lidar2img"
    images: str = ""

    def value(self, observed: Observed) -> Array:
        """Return float32 [cameras, 4, 4]."""
        return _projections(observed, self.images).astype(np.float32)


@dataclass(frozen=True)
class LidarToCamera(InputSource):
    """The model's ground frame to x right, y down, z forward: [cameras, 4, 4].

    Attributes:
        images: The image input whose cameras they are; empty where there is one.
    """

    name: ClassVar[str] = "lidar2cam"
    images: str = ""

    def value(self, observed: Observed) -> Array:
        """Return float64 [cameras, 4, 4]."""
        projections = _projections(observed, self.images)
        matrices = projections.copy()
        inverse = np.linalg.inv(_intrinsics(projections))
        matrices[:, :3] = inverse @ projections[:, :3]
        return matrices


@dataclass(frozen=True)
class Intrinsics(InputSource):
    """Camera frame to pixels, camera by camera: [cameras, 3, 3], or 4 by 4.

    Attributes:
        images: The image input whose pixels they are; empty where there is one.
        homogeneous: Pad to 4 by 4 with a row and a column of the unit matrix.
    """

    name: ClassVar[str] = "intrinsics"
    images: str = ""
    homogeneous: bool = False

    def value(self, observed: Observed) -> Array:
        """Return float64 [cameras, 3, 3], or [cameras, 4, 4]."""
        matrices = _intrinsics(_projections(observed, self.images))
        if not self.homogeneous:
            return matrices
        padded = np.tile(np.eye(4), (len(matrices), 1, 1))
        padded[:, :3, :3] = matrices
        return padded


def _projections(observed: Observed, images: str) -> Floats:
    """Return [cameras, 4, 4], the model's ground frame to an image input's pixels."""
    there = observed.projections
    if images in there:
        lidar2img = there[images]
    elif not images and len(there) == 1:
        (lidar2img,) = there.values()
    else:
        raise EvaluationError(
            f"images = {images!r} names no image input; there are {', '.join(there)}"
        )
    return observed.axes.projection(lidar2img).astype(np.float64)


def _intrinsics(projections: Floats) -> Floats:
    """Return [cameras, 3, 3], upper triangular, the last row (0, 0, 1)."""
    # The rows of K R are f r1 + c r3, g r2 + d r3 and r3, with orthonormal r: no camera
    # here has skew
    rows, forward = projections[:, :2, :3], projections[:, 2, :3]
    centre = np.einsum("kij,kj->ki", rows, forward)
    focal = np.linalg.norm(rows - centre[..., None] * forward[:, None], axis=2)
    matrices = np.tile(np.eye(3), (len(projections), 1, 1))
    matrices[:, 0, 0], matrices[:, 1, 1] = focal[:, 0], focal[:, 1]
    matrices[:, :2, 2] = centre
    return matrices
