"""Pose and motion of the ego."""

from dataclasses import dataclass

Triple = tuple[float, float, float]


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
