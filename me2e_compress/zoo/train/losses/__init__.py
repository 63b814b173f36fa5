"""How far each module is from its labels."""

from me2e_compress.zoo.train.losses.ground import map_losses, occ_losses
from me2e_compress.zoo.train.losses.lamps import LampHead
from me2e_compress.zoo.train.losses.plan import plan_losses
from me2e_compress.zoo.train.losses.track import motion_losses, track_losses

__all__ = [
    "LampHead",
    "map_losses",
    "motion_losses",
    "occ_losses",
    "plan_losses",
    "track_losses",
]
