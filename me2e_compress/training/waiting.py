"""Who waits for somebody in a junction stands: labels that do not creep."""

import numpy as np
import numpy.typing as npt

from me2e_compress.training.stored_episode import Array
from me2e_compress.zoo.highway.config import STEP_S

Floats = npt.NDArray[np.floating]
Flags = npt.NDArray[np.bool_]

JUNCTION = (0, 1, 2)
"""Commands given in a junction: left, right, straight."""
SLOW_MPS = 2.0
"""Only who is slower than this can stand within a metre of `BRAKE_MPS2`."""
CREEPING_MPS = 1.5
"""Speed at the end of a plan that goes on rolling, and does not set off."""
HELD_M = 2.0
"""Without anybody there the plan would be so much longer: it waits for somebody."""
BRAKE_MPS2 = 2.0
"""A comfortable stop."""


def creeps(moves: Floats, tables: dict[str, Array], alone: Floats) -> Flags:
    """Which plans roll on slowly towards somebody who has to be let by.

    The expert weighs such a plan afresh at every frame and knows everybody's speed to
    the centimetre; who imitates it rolls a little faster, and into the conflict.

    Args:
        moves: [N, 6, 2] metres along the route and aside.
        tables: ``can_bus`` and ``command`` of N samples.
        alone: [N, 6, 2] the plans without anybody, in the ego frame.
    """
    arc = moves[..., 0]
    slow = tables["can_bus"][:, 7] < SLOW_MPS
    rolls = (arc[:, -1] - arc[:, -2]) / STEP_S < CREEPING_MPS
    held = np.hypot(alone[:, -1, 0], alone[:, -1, 1]) > arc[:, -1] + HELD_M
    return np.asarray(slow & rolls & held & np.isin(tables["command"], JUNCTION))


def stopping(plans: Floats, speed_mps: Floats) -> Floats:
    """The same plans, shortened to a comfortable stop.

    Args:
        plans: [N, 6, 2] of any frame that begins where the ego is.
        speed_mps: [N] now.
    """
    times = STEP_S * np.arange(1, plans.shape[1] + 1)
    speed = np.maximum(speed_mps, 0.0)[:, None]
    braking = np.minimum(times, speed / BRAKE_MPS2)
    travel = speed * braking - BRAKE_MPS2 / 2 * braking**2
    length = np.linalg.norm(np.diff(plans, axis=1, prepend=0.0), axis=-1).cumsum(1)
    share = np.minimum(travel / np.maximum(length, 1e-6), 1.0)
    return np.asarray(plans * share[..., None])
