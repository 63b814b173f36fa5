"""The vehicle's own motion as an input."""

from torch import nn

from me2e_compress.zoo.bev.sizes import EMBED

CAN_BUS = 18
"""Metres since the last frame (3), quaternion (4), speed (3), acceleration (3), angular
rate (3), yaw in radians, change of yaw in degrees."""


class CanBusEncoder(nn.Sequential):
    """Maps ego motion to a vector that is added to every BEV query."""

    def __init__(self) -> None:
        super().__init__(
            nn.Linear(CAN_BUS, EMBED // 2),
            nn.ReLU(),
            nn.Linear(EMBED // 2, EMBED),
            nn.ReLU(),
        )
        self.add_module("norm", nn.LayerNorm(EMBED))
