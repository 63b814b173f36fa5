"""Scores of one route: driving score, efficiency, comfort, and room kept to others."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
import numpy.typing as npt

from me2e_compress.metrics.episode import (
    COLLISIONS,
    CROSSING_RAD,
    FRAME_US,
    EgoFrame,
    Ending,
    Episode,
)
from me2e_compress.metrics.measure import Measure

DIGITS = 6  # digits to which the leaderboard rounds each of the three scores


@dataclass(frozen=True, slots=True)
class RouteScore:
    """Scores of one route: route and composed in percent, penalty as a factor."""

    route: float
    penalty: float
    composed: float


def route_score(episode: Episode) -> RouteScore:
    """Return completion, penalty and their product (equation 5, one summand).

    As in the leaderboard (statistics_manager.py of Bench2Drive 0.0.3), every infraction
    multiplies the completed percentage by its factor.
    """
    penalty = math.prod(infraction.factor for infraction in episode.infractions)
    route = episode.completion_percent
    return RouteScore(
        round(route, DIGITS),
        round(penalty, DIGITS),
        round(max(route * penalty, 0.0), DIGITS),
    )


# Driving efficiency: the ego's speed relative to the traffic around it.

CHECKPOINTS = 20
OUTLIER_PERCENT = 1000.0
# Beyond this Bench2Drive also reports the speed over the last stretch
DONE_PERCENT = 95.0
PERCENT = "%"


def efficiency(episode: Episode) -> Measure:
    """Return the mean of ego speed over traffic speed at 20 check points, in percent.

    Equation 6: at each check point, every twentieth of the route, the mean ego speed
    since the last one is divided by that of nearby vehicles. Ratios above 1000 % and
    check points without moving traffic are dropped. A route that ends within its first
    5 % has no efficiency.
    """
    ratios = speed_ratios(episode)
    if episode.completion_percent < 100.0 / CHECKPOINTS:
        return Measure(None, PERCENT, "the ego did not pass the first 5 % of the route")
    usual = [ratio for ratio in ratios if ratio <= OUTLIER_PERCENT]
    if not usual:
        return Measure(None, PERCENT, "no check point saw moving traffic")
    return Measure(fmean(usual), PERCENT)


def speed_ratios(episode: Episode) -> tuple[float, ...]:
    """Return the ratio at each check point that saw moving traffic, in percent.

    Ratios reported by the simulator take precedence. Bench2Drive writes the last one
    twice if more than 95 % of the route was passed; it is kept once.
    """
    if (reported := episode.speed_ratios_percent) is not None:
        done = episode.completion_percent > DONE_PERCENT
        twice = done and len(reported) > 1 and reported[-1] == reported[-2]
        return reported[:-1] if twice else reported
    # Cut the frames at the check points
    spacing_m = episode.route_length_m / CHECKPOINTS
    passed, stretches = 0, list[list[EgoFrame]]([[]])
    for frame in episode.frames:
        stretches[-1].append(frame)
        reached = int(frame.route_m / spacing_m)
        if reached > passed:
            passed = reached
            stretches.append([])
    # The last stretch counts only if it ends at the goal
    ended = episode.ending is Ending.COMPLETED and passed < CHECKPOINTS
    sums = map(beside_traffic, stretches if ended else stretches[:-1])
    return tuple(100.0 * ego / traffic for ego, traffic, _ in sums if traffic > 0.0)


def beside_traffic(stretch: Sequence[EgoFrame]) -> tuple[float, float, int]:
    """Return summed ego and traffic speeds (m/s) of frames with traffic; how many."""
    ego, traffic = list[float](), list[float]()
    for frame in stretch:
        if frame.traffic_speed_mps is not None:
            ego.append(frame.speed_mps)
            traffic.append(frame.traffic_speed_mps)
    return sum(ego), sum(traffic), len(ego)


# Driving comfort: the share of seconds with every variable in its range.

SEGMENT_FRAMES = 20
WINDOW = 7
ORDER = 2
BLOCKED_SPEED_MPS = 0.1
BLOCKED_US = 60_000_000

Floats = npt.NDArray[np.float64]

# The paper's table 1 in SI units: the 99th percentiles of human drivers that nuPlan's
# comfort metric uses
LOWEST_ACCELERATION_MPS2, HIGHEST_ACCELERATION_MPS2 = -4.05, 2.40
LATERAL_ACCELERATION_MPS2 = 4.89
YAW_RATE_RADPS, YAW_ACCELERATION_RADPS2 = 0.95, 1.93
LONGITUDINAL_JERK_MPS3, JERK_MPS3 = 4.13, 8.37


def comfort(episode: Episode) -> Measure:
    """Return the share of segments of 20 frames in which every frame is smooth.

    Equation 7 with all six variables in SI units and the frames' own interval, which is
    0.05 s unless a real run recorded fewer frames:

    * accelerations and yaw rate are smoothed (Savitzky-Golay, 7 frames, order 2) over
      the whole route before it is cut into segments;
    * yaw acceleration and longitudinal jerk are the filter's derivatives of yaw rate
      and longitudinal acceleration; the jerk is the norm of the derivative of the
      acceleration vector in the plane of the road;
    * the bounds are inclusive, and an incomplete last segment is dropped;
    * frames of a stop that blocks the route always count as smooth (at most 0.1 m/s for
      60 s, where the route ends; the paper's "more than 60 s" never occurs).
    """
    if len(episode.frames) < SEGMENT_FRAMES:
        frames = len(episode.frames)
        return Measure(None, "ratio", f"{frames} frames, {SEGMENT_FRAMES} are needed")
    smooth = smooth_frames(episode)
    segments = len(smooth) // SEGMENT_FRAMES
    cut = smooth[: segments * SEGMENT_FRAMES].reshape(segments, SEGMENT_FRAMES)
    return Measure(float(cut.all(axis=1).mean()), "ratio")


def smooth_frames(episode: Episode) -> npt.NDArray[np.bool_]:
    """Return for each of at least 7 frames whether all six variables are in range."""
    frames = episode.frames
    # The jerk needs the acceleration vector in the world
    along = np.array([frame.acceleration_mps2 for frame in frames])
    left = np.array([frame.lateral_acceleration_mps2 for frame in frames])
    heading = np.array([frame.heading for frame in frames])
    yaw_rate = np.array([frame.yaw_rate_radps for frame in frames])
    east = along * np.cos(heading) - left * np.sin(heading)
    north = along * np.sin(heading) + left * np.cos(heading)
    times_us = np.array([frame.time_us for frame in frames])
    delta_s = (int(np.median(np.diff(times_us))) or FRAME_US) / 1e6
    # Every variable against its bounds
    acceleration = filtered(along)
    jerk_east, jerk_north = (filtered(axis, delta_s, 1) for axis in (east, north))
    return (
        (acceleration >= LOWEST_ACCELERATION_MPS2)
        & (acceleration <= HIGHEST_ACCELERATION_MPS2)
        & (np.abs(filtered(left)) <= LATERAL_ACCELERATION_MPS2)
        & (np.abs(filtered(yaw_rate)) <= YAW_RATE_RADPS)
        & (np.abs(filtered(yaw_rate, delta_s, 1)) <= YAW_ACCELERATION_RADPS2)
        & (np.abs(filtered(along, delta_s, 1)) <= LONGITUDINAL_JERK_MPS3)
        & (np.hypot(jerk_east, jerk_north) <= JERK_MPS3)
    ) | _blocked_frames(episode)


def filtered(
    values: Floats, delta_s: float = 1.0, derivative: int = 0, window: int = WINDOW
) -> Floats:
    """Smooth values, or every row of them, by Savitzky and Golay's filter."""
    from scipy.signal import savgol_filter  # takes half a second to import

    smoothed: Any = savgol_filter(values, window, ORDER, derivative, delta_s)
    return np.asarray(smoothed, np.float64)


def _blocked_frames(episode: Episode) -> npt.NDArray[np.bool_]:
    """Mark the frames of every stop of 60 s, and of the stop that ended the route."""
    still = [frame.speed_mps <= BLOCKED_SPEED_MPS for frame in episode.frames]
    blocked = np.zeros(len(still), np.bool_)
    edges = np.flatnonzero(np.diff([False, *still, False]))
    for start, end in edges.reshape(-1, 2):
        lasted = episode.frames[end - 1].time_us - episode.frames[start].time_us
        ended = end == len(still) and episode.ending is Ending.BLOCKED
        blocked[start:end] = lasted >= BLOCKED_US or ended
    return blocked


# Surrogate safety measures: how near an episode came to a collision, and its fault. Few
# routes end in one, so collisions alone separate drivers slowly; these measures also
# count near misses. Each is None if its input was not recorded.

# A time to collision below this is a conflict: SSAM's default (Gettman et al. 2008,
# FHWA-HRT-08-051), after Van der Horst and Hogema 1993.
TTC_CRITICAL_S = 1.5

NOT_RECORDED = "nobody recorded the distances to others"


def ttc_exposure(episode: Episode) -> Measure:
    """Return the share of frames with a time to collision below 1.5 s, in percent.

    This is the time exposed (TET, Minderhoud and Bovy 2001) over the time driven.
    """
    conflicts = episode.conflicts
    if conflicts is None or not conflicts.ttc_s:
        return Measure(None, "%", NOT_RECORDED)
    exposed = sum(ttc is not None and ttc < TTC_CRITICAL_S for ttc in conflicts.ttc_s)
    return Measure(100.0 * exposed / len(conflicts.ttc_s), "%")


def room_kept(episode: Episode) -> Measure:
    """Return how much room a route kept to others, a grade from 0 to 100 percent.

    It is the share of frames without a contact within 1.5 s, times the part of 1.5 s
    that the smallest post-encroachment time reaches, at most 1; 0 after a collision
    that was the ego's fault. The driving score sees neither near misses nor faults.
    """
    exposed, pet = ttc_exposure(episode).value, smallest_pet(episode).value
    room = room_of(exposed, pet, at_fault_collision(episode))
    if room is None:
        why = "whose fault a collision was is not known"
        return Measure(None, "%", NOT_RECORDED if exposed is None else why)
    return Measure(room, "%")


def room_of(
    ttc_exposure: float | None, smallest_pet: float | None, at_fault: bool | None
) -> float | None:
    """Return `room_kept` of its three parts; None if the first or last is unknown."""
    if ttc_exposure is None or at_fault is None:
        return None
    share = 1.0 if smallest_pet is None else min(smallest_pet / TTC_CRITICAL_S, 1.0)
    return 0.0 if at_fault else (100.0 - ttc_exposure) * share


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
    crossing = [met.pet_s for met in encounters if met.angle_rad >= CROSSING_RAD]
    return _smallest(episode, crossing, "s", "no paths crossed within 5 s")


def at_fault_collision(episode: Episode) -> bool | None:
    """Return whether a collision was the ego's fault, None if unknown."""
    collisions = (one for one in episode.infractions if one.kind in COLLISIONS)
    faults = [collision.at_fault for collision in collisions]
    return True if any(faults) else None if None in faults else False


def _smallest(
    episode: Episode, column: Iterable[float | None], unit: str, reason: str
) -> Measure:
    if episode.conflicts is None:
        return Measure(None, unit, NOT_RECORDED)
    values = [value for value in column if value is not None]
    return Measure(min(values), unit) if values else Measure(None, unit, reason)
