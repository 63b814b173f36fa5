"""What it costs to touch, nearly touch, or cut off an actor."""

import numpy as np

from me2e_compress.evaluators.highway.expert.forecast import TIMES_S, Flags, Forecast
from me2e_compress.evaluators.highway.expert.futures import SampledFutures
from me2e_compress.evaluators.highway.expert.lateral_targets import Place
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import Ego

COLLISION, NEAR_MISS, CUT_OFF = 200.0, 8.0, 30.0
FADE = np.exp(-TIMES_S / 3.0)
"""[18] far futures weigh less."""
MARGIN_M, NEAR_M = 0.35, 1.3
"""Beyond contact: certainly avoided, and preferably avoided."""
CORNER_M = 0.1
"""Added to the discs, which miss 0.41 m at the corners of the ego; less than
`MARGIN_M` remains."""
SWEEP_S = 0.12
"""Everybody is this much longer at both ends, since the times are 0.25 s apart."""
REACH_M = 12.0
"""Half of two long vehicles and the margins; who is farther away needs no look."""
PRIORITY_S = 1.3
"""Nobody is to be met within this time ahead of a moving car's bumper."""


def collision_cost(
    future: SampledFutures, seen: Forecast, ego: Ego, place: Place
) -> Floats:
    """[K] cost of touching, nearly touching, or cutting off an actor.

    The ego is four discs of its width, an actor its rectangle, longer in front by
    what it drives in `PRIORITY_S`. Who follows in the ego's own lane looks after
    himself.
    """
    others = ~followers(seen, ego, place) & _in_reach(future, seen)
    if not np.any(others):
        return np.zeros(len(future.acceleration))
    apart, cut = _clearances(future, seen, ego, others)
    worst = COLLISION * _worst(apart, MARGIN_M)
    worst += NEAR_MISS * _worst(apart, NEAR_M) + CUT_OFF * _worst(cut, MARGIN_M)
    return np.asarray(np.sum(worst, axis=0))


def followers(seen: Forecast, ego: Ego, place: Place) -> Flags:
    """[A] whether an actor follows the ego, in a lane that the ego is in."""
    aligned = np.cos(seen.away[:, 0]) > 0.5
    apart = np.abs(seen.lateral_m[:, 0] - place.lateral_m)
    beside = apart < seen.half_breadth[:, 0] + ego.width / 2
    behind = seen.along_m[:, 0] < place.s_m
    return np.asarray(aligned & beside & behind & seen.yields)


def _in_reach(future: SampledFutures, seen: Forecast) -> Flags:
    """[A] whether an actor comes near anything that the ego might do."""
    margin = REACH_M + PRIORITY_S * seen.speed_mps[:, 1:]
    near = np.ones_like(margin, bool)
    for mine, other in ((future.x, seen.x), (future.y, seen.y)):
        near &= other[:, 1:] + margin > np.min(mine, axis=0)
        near &= other[:, 1:] - margin < np.max(mine, axis=0)
    return np.asarray(near.any(axis=1))


def _worst(clearance: Floats, margin: float) -> Floats:
    """[A, K] the largest faded intrusion into a margin, 0 to 1."""
    inside = np.clip((margin - clearance) / margin, 0.0, 1.0)
    return np.asarray(np.max(inside * FADE, axis=-1))


def _clearances(
    future: SampledFutures, seen: Forecast, ego: Ego, others: Flags
) -> tuple[Floats, Floats]:
    """Metres from the ego's discs to each actor, and to its way ahead: [A, K, T]."""
    radius = ego.width / 2 + CORNER_M
    reach = (ego.length - ego.width) / 2 + SWEEP_S * future.speed_mps
    x, y, heading, speed = (
        column[others, None, 1:]
        for column in (seen.x, seen.y, seen.heading, seen.speed_mps)
    )
    cos, sin = np.cos(heading), np.sin(heading)
    half_length = seen.length[others, None, None] / 2 + SWEEP_S * speed
    half_width = seen.width[others, None, None] / 2
    front = half_length + speed * PRIORITY_S * seen.moves[others, None, None]
    shift = reach * np.stack([np.cos(future.heading), np.sin(future.heading)])
    apart = np.full((len(x), *future.x.shape), np.inf)
    cut = apart
    for disc in (-1.0, -1 / 3, 1 / 3, 1.0):
        dx = (future.x + disc * shift[0])[None] - x
        dy = (future.y + disc * shift[1])[None] - y
        ahead = cos * dx + sin * dy
        side = np.maximum(np.abs(cos * dy - sin * dx) - half_width, 0.0)
        side *= side
        end = np.maximum(np.abs(ahead) - half_length, 0.0)
        way = np.maximum(np.maximum(ahead - front, -half_length - ahead), 0.0)
        end, way = end * end + side, way * way + side
        apart = np.minimum(apart, end)
        cut = np.minimum(cut, way)
    return np.sqrt(apart) - radius, np.sqrt(cut) - radius
