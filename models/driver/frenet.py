"""Plans in the frame of the route."""

import numpy as np
import numpy.typing as npt

from models.driver.network.config import PATH_STEP_M

Floats = npt.NDArray[np.floating]

ASIDE = 2.0
"""A metre to the side counts as two along the route, as in the loss of the plan."""


def project(points: Floats, path: Floats) -> Floats:
    """Return the arc length and offset of points beside a route.

    Args:
        points: [N, T, 2] metres.
        path: [N, P, 2] metres, `PATH_STEP_M` apart.

    Returns:
        float32 [N, T, 2]: metres along the route, metres left of it.
    """
    start, step = path[:, None, :-1], np.diff(path, axis=1)[:, None]
    away = points[:, :, None] - start
    share = np.clip((away * step).sum(-1) / (step * step).sum(-1), 0.0, 1.0)
    miss = away - share[..., None] * step
    distance = np.hypot(miss[..., 0], miss[..., 1])
    nearest = distance.argmin(-1)[..., None]
    arc = (np.take_along_axis(share, nearest, -1) + nearest)[..., 0] * PATH_STEP_M
    side = step[..., 0] * away[..., 1] - step[..., 1] * away[..., 0]
    sign = np.sign(
        np.take_along_axis(np.broadcast_to(side, distance.shape), nearest, -1)
    )
    offset = np.take_along_axis(distance, nearest, -1)[..., 0] * sign[..., 0]
    return np.stack([arc, offset], -1).astype(np.float32)


def anchors_of(plans: Floats, count: int, rounds: int = 15) -> Floats:
    """Return typical plans: k-means from a farthest-point start that keeps rare ones.

    Args:
        plans: [N, T, 2] arc lengths and offsets.
        count: how many.
        rounds: of k-means.

    Returns:
        float32 [count, T, 2].
    """
    scale = np.array([1.0, ASIDE])
    rows = (plans * scale).reshape(len(plans), -1)
    chosen = [rows.mean(0)]
    nearest = ((rows - chosen[0]) ** 2).sum(1)
    while len(chosen) < count:
        chosen.append(rows[int(nearest.argmax())])
        nearest = np.minimum(nearest, ((rows - chosen[-1]) ** 2).sum(1))
    centres = np.array(chosen)
    for _ in range(rounds):
        square = (centres**2).sum(1) - 2 * rows @ centres.T
        owner = square.argmin(1)
        for k in np.unique(owner):
            centres[k] = rows[owner == k].mean(0)
    return np.asarray(centres.reshape(count, -1, 2) / scale, np.float32)
