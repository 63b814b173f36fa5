"""Dimensions of TCP (OpenDriveLab/TCP; Bench2DriveZoo, branch tcp/admlp)."""

from dataclasses import dataclass
from typing import Literal

ActionHeads = Literal["bench2drive", "beta"]

COMMANDS = 6
"""Road options of CARLA, as a one-hot vector."""

STATE = 1 + 2 + COMMANDS
"""Speed over `SPEED_UNIT_MPS`, target point, command."""

SPEED_UNIT_MPS = 12.0

ACTIONS = 39
"""Bench2Drive: throttle, steer, brake and reverse in as many combinations."""

DISTRIBUTIONS = 2
"""The original: one Beta distribution of acceleration and one of steer."""

ACTION_SIZE: dict[ActionHeads, int] = {
    "bench2drive": ACTIONS,
    "beta": 2 * DISTRIBUTIONS,
}
"""Outputs per action: logits, or both parameters of each distribution."""


@dataclass(frozen=True)
class TcpConfig:
    """Sizes of TCP; the defaults are the published ones.

    Attributes:
        image_hw: pixels of the strip of three cameras.
        stem: channels of the first stage of the image trunk, a ResNet.
        classes: width of the image vector.
        measured: width of the measurement vector.
        joint: width of the layers that join image and measurements.
        hidden: width of the recurrent cells.
        steps: number of waypoints and actions, 0.5 s apart.
    """

    image_hw: tuple[int, int] = (256, 900)
    stem: int = 64
    classes: int = 1000
    measured: int = 128
    joint: int = 512
    hidden: int = 256
    steps: int = 4

    @property
    def map_hw(self) -> tuple[int, int]:
        """Rows and columns of the last feature map, stride 32."""
        height, width = self.image_hw
        return -(-height // 32), -(-width // 32)
