"""How far each module is from its labels."""

from me2e_compress.training.losses.ground_losses import map_losses, occ_losses
from me2e_compress.training.losses.lamps import LampHead
from me2e_compress.training.losses.planning_loss import plan_losses
from me2e_compress.training.losses.tracking_loss import motion_losses, track_losses

__all__ = [
    "LampHead",
    "map_losses",
    "motion_losses",
    "occ_losses",
    "plan_losses",
    "track_losses",
]
