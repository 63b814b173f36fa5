"""Surrogate safety measures: how near an episode came to a collision, and its fault.

Few routes end in a collision, so collisions alone separate drivers slowly; these
measures also count near misses. Each is None if its input was not recorded.
"""

from collections.abc import Iterable

from me2e_compress.metrics.episode import CROSSING_RAD, Episode
from me2e_compress.metrics.infraction import COLLISIONS
from me2e_compress.metrics.measure import Measure

TTC_CRITICAL_S = 1.5
"""A time to collision below this is a conflict: SSAM's default (Gettman et al. 2008,
FHWA-HRT-08-051), after Van der Horst and Hogema 1993."""

NOT_RECORDED = "nobody recorded the distances to others"


def ttc_exposure(episode: Episode) -> Measure:
    """Return the share of frames with a time to collision below 1.5 s, in percent.

    This is the time exposed (TET, Minderhoud and Bovy 2001) over the time driven.
    """
    found = episode.conflicts
    if found is None or not found.ttc_s:
        return Measure(None, "%", NOT_RECORDED)
    exposed = sum(ttc is not None and ttc < TTC_CRITICAL_S for ttc in found.ttc_s)
    return Measure(100.0 * exposed / len(found.ttc_s), "%")


def room_kept(episode: Episode) -> Measure:
    """Return how much room a route kept to others, a grade from 0 to 100 percent.

    It is the share of frames without a contact within 1.5 s, times the part of 1.5 s
    that the smallest post-encroachment time reaches, at most 1; 0 after a collision
    that was the ego's fault. The driving score sees neither near misses nor faults.
    """
    exposed, pet = ttc_exposure(episode).value, smallest_pet(episode).value
    kept = room_of(exposed, pet, at_fault_collision(episode))
    if kept is None:
        why = "whose fault a collision was is not known"
        return Measure(None, "%", NOT_RECORDED if exposed is None else why)
    return Measure(kept, "%")


def room_of(
    ttc_exposure: float | None, smallest_pet: float | None, at_fault: bool | None
) -> float | None:
    """Return `room_kept` of its three parts; None if the first or last is unknown."""
    if ttc_exposure is None or at_fault is None:
        return None
    kept = 1.0 if smallest_pet is None else min(smallest_pet / TTC_CRITICAL_S, 1.0)
    return 0.0 if at_fault else (100.0 - ttc_exposure) * kept


def smallest_ttc(episode: Episode) -> Measure:
    """Return the smallest time to collision of a route, seconds; 0 if it collided."""
    seconds = () if episode.conflicts is None else episode.conflicts.ttc_s
    return _smallest(episode, seconds, "s", "no contact was ever within 10 s")


def smallest_distance(episode: Episode) -> Measure:
    """Return the smallest distance between the outlines of ego and others, metres."""
    metres = () if episode.conflicts is None else episode.conflicts.nearest_m
    return _smallest(episode, metres, "m", "nobody else was there")


def smallest_pet(episode: Episode) -> Measure:
    """Return the smallest post-encroachment time of crossing paths, seconds.

    Only encounters at 30 degrees or more, at most 5 s apart, count.
    """
    encounters = () if episode.conflicts is None else episode.conflicts.encounters
    crossing = [each.pet_s for each in encounters if each.angle_rad >= CROSSING_RAD]
    return _smallest(episode, crossing, "s", "no paths crossed within 5 s")


def at_fault_collision(episode: Episode) -> bool | None:
    """Return whether a collision was the ego's fault, None if unknown."""
    faults = [each.at_fault for each in episode.infractions if each.kind in COLLISIONS]
    if any(faults):
        return True
    return None if None in faults else False


def _smallest(
    episode: Episode, column: Iterable[float | None], unit: str, reason: str
) -> Measure:
    if episode.conflicts is None:
        return Measure(None, unit, NOT_RECORDED)
    values = [value for value in column if value is not None]
    return Measure(min(values), unit) if values else Measure(None, unit, reason)
