"""Record of how close an episode came to a collision."""

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import ConfigDict, Field, with_config

TTC_HORIZON_S = 10.0
"""A contact later than this is not written down: our choice, far beyond every
threshold in use (0.95 s in nuPlan, 1.5 s in SSAM, 4 s in driver assistance)."""

PET_HORIZON_S = 5.0
"""Longest post-encroachment time: SSAM's default (FHWA-HRT-08-051)."""

CROSSING_RAD = math.radians(30.0)
"""From this angle between headings paths cross or merge; below it one follows the
other, and the time between them is a headway: SSAM's rear-end angle."""

Distance = Annotated[float, Field(ge=0.0, le=1e9)]
Seconds = Annotated[float, Field(ge=0.0, le=1e9)]

_STRICT = ConfigDict(allow_inf_nan=False, extra="forbid")


@with_config(_STRICT)
@dataclass(frozen=True, slots=True)
class Encounter:
    """The ego and a moving actor were at the same place, one after the other.

    Attributes:
        time_us: When the second of the two arrived.
        pet_s: Post-encroachment time (Allen, Shin and Cooper 1978; SAE J2944): from the
            moment when the first left a place until the second arrived, the minimum
            over all places; 0 in a collision. A multiple of the frame interval.
        angle_rad: Angle between their headings, 0 (same direction) to pi (oncoming).
    """

    actor: int
    kind: str
    time_us: int
    pet_s: Seconds
    angle_rad: Annotated[float, Field(ge=0.0, le=3.15)]
    ego_first: bool


@with_config(_STRICT)
@dataclass(frozen=True, slots=True)
class ConflictRecord:
    """Distances and times to collision for each frame, and all encounters.

    Attributes:
        nearest_m: Metres from the ego's outline to that of the nearest actor, 0 if they
            overlap, None if there is no actor.
        ttc_s: Time to collision: seconds until the ego's box and an actor's touch if
            both keep heading and speed, the minimum over all actors; None above 10 s
            (`TTC_HORIZON_S`). Defined as in nuPlan and NAVSIM, but exact where they try
            steps of 0.1 and 0.3 s, and including actors from behind.
        encounters: Those of at most 5 s (`PET_HORIZON_S`), in order of time; an actor
            has at most one with crossing or merging paths and one in the ego's
            direction.
    """

    nearest_m: tuple[Distance | None, ...]
    ttc_s: tuple[Seconds | None, ...]
    encounters: tuple[Encounter, ...]
