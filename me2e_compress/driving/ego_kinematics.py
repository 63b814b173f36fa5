"""Where the ego is and how it moves."""

from dataclasses import dataclass

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class EgoKinematics:
    """Where the ego is and how it moves, in a right-handed world (x east, y north).

    Args:
        x: Metres.
        y: Metres.
        heading: Radians counter-clockwise from east.
        speed_mps: Forward.
        acceleration_mps2: In the ego frame.
        angular_velocity_radps: In the ego frame.
    """

    x: float
    y: float
    heading: float
    speed_mps: float
    acceleration_mps2: Triple
    angular_velocity_radps: Triple
