"""The losses of every module against its labels."""

from models.driver.losses.detection_losses import (
    LampHead,
    motion_losses,
    track_losses,
)
from models.driver.losses.ground_losses import map_losses, occ_losses
from models.driver.losses.planning_losses import plan_losses

__all__ = [
    "LampHead",
    "map_losses",
    "motion_losses",
    "occ_losses",
    "plan_losses",
    "track_losses",
]
