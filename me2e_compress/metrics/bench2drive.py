"""Bench2Drive's own arithmetic, reproduced exactly and kept apart from ours.

What its tools compute (tools/efficiency_smoothness_benchmark.py, branches 0.0.3 and
0.0.4) differs from what their names say. The published tables were made with it, so it
is reproduced here with its faults:

* comfort compares degrees per second with a bound in radians per second, never takes
  the derivative of the yaw rate that it calls yaw acceleration, differentiates with 0.1
  s although frames are 0.05 s apart, smooths every block of 20 frames on its own and
  the jerk twice, and differentiates the norm of the acceleration;
* efficiency reports 100 % at check points without traffic and counts the last one
  twice.
"""

from statistics import fmean

import numpy as np

from me2e_compress.metrics import route_scores as ours
from me2e_compress.metrics.episode import EgoFrame, Episode, InfractionKind
from me2e_compress.metrics.measure import Measure

BLOCK_FRAMES = 20
DELTA_S = 0.1
SUCCESSES = ("Completed", "Perfect")


def success(episode: Episode) -> bool:
    """Return whether a record counts as a success (tools/merge_route_json.py).

    Its status must be Completed or Perfect, with no infraction but low speed; a record
    without a status falls back to `Episode.succeeded`.
    """
    if episode.given is None:
        return episode.succeeded
    kinds = {infraction.kind for infraction in episode.infractions}
    return episode.given.status in SUCCESSES and kinds <= {InfractionKind.MIN_SPEED}


def efficiency(episode: Episode) -> Measure:
    """Return the mean percentage of the check points that are at most 1000 %."""
    ratios = [ratio for ratio in speed_ratios(episode) if ratio <= ours.OUTLIER_PERCENT]
    if not ratios:
        return Measure(None, ours.PERCENT, "no check point below 1000 %")
    return Measure(fmean(ratios), ours.PERCENT)


def speed_ratios(episode: Episode) -> tuple[float, ...]:
    """Return the percentages that MinimumSpeedRouteTest would have reported.

    A check point is reached when more than a twentieth of the route, counted in whole
    metres, was passed since the last one; the rest counts if more than 95 % is done.
    """
    if episode.speed_ratios_percent is not None:
        return episode.speed_ratios_percent

    def percent(stretch: list[EgoFrame]) -> float:
        ego, traffic, count = ours.beside_traffic(stretch)
        if traffic == 0.0:
            return 100.0
        return round(100.0 * (ego / count) / (traffic / count), 2)

    # Cut the frames at the check points
    spacing_m = episode.route_length_m / ours.CHECKPOINTS
    ratios, passed_m, stretch = list[float](), 0, list[EgoFrame]()
    for frame in episode.frames:
        stretch.append(frame)
        if int(frame.route_m) - passed_m > spacing_m:
            ratios.append(percent(stretch))
            passed_m, stretch = int(frame.route_m), []
    # The original reports the rest twice
    if episode.completion_percent > ours.DONE_PERCENT:
        ratios += 2 * [percent(stretch)]
    return tuple(ratios)


def smoothness(episode: Episode) -> Measure:
    """Return the share of smooth blocks of 20 frames ("Driving Smoothness")."""
    frames = episode.frames
    if len(frames) < 3:
        return Measure(None, "ratio", f"{len(frames)} frames, 3 are needed")
    # Columns: along, across, norm, yaw rate in degrees per second
    rows = list[tuple[float, ...]]()
    for frame in frames:
        along, across = frame.acceleration_mps2, frame.lateral_acceleration_mps2
        norm = frame.acceleration_norm_mps2
        norm = float(np.hypot(along, across)) if norm is None else norm
        rows.append((along, across, norm, float(np.degrees(frame.yaw_rate_radps))))
    columns = np.array(rows).T  # (4, frames)
    # Whole blocks only; the rest is dropped
    length = min(len(frames), BLOCK_FRAMES)
    blocks = len(frames) // length
    cut = columns[:, : blocks * length].reshape(len(columns), blocks, length)

    def smoothed(values: ours.Floats, derivative: int = 0) -> ours.Floats:
        return ours.filtered(values, DELTA_S, derivative, min(ours.WINDOW, length))

    a_along, a_across, a_norm = map(smoothed, cut[:3])  # (blocks, length) each
    # As the original: degrees are unwrapped as if they were radians
    turns = np.round(np.diff(cut[3]) / (2.0 * np.pi)).cumsum(axis=1)
    turned = np.pad(turns, ((0, 0), (1, 0)))
    yaw_rate = smoothed(cut[3] - 2.0 * np.pi * turned)
    # The last bound is in radians; the original's yaw acceleration is the yaw rate, of
    # which it asks less than 1.93 too
    within = (
        (a_along > -4.05) & (a_along < 2.40),
        np.abs(a_across) < 4.89,
        np.abs(smoothed(a_norm, 1)) < 8.37,
        np.abs(smoothed(a_along, 1)) < 4.13,
        np.abs(yaw_rate) < 0.95,
    )
    smooth = np.logical_and.reduce(within).all(axis=1)
    return Measure(fmean(smooth.tolist()), "ratio")


# Bench2Drive's five abilities. A route counts under every ability that it tests; routes
# without a record are not counted. For Traffic_Signs a route also counts that failed,
# but *passed the junction*: the ego came more than 8 m into it and ran no stop sign or
# red light (tools/ability_benchmark.py, branch 0.0.4).

ABILITIES = ("Overtaking", "Merging", "Emergency_Brake", "Give_Way", "Traffic_Signs")
TRAFFIC_SIGNS = "Traffic_Signs"

# How far past the start of a junction the ego must come to have obeyed its signs
JUNCTION_MARGIN_M = 8.0


def mastered(episode: Episode, ability: str) -> bool | None:
    """Return whether a route counts as a success for one of its abilities.

    None where that is not known: a real run does not say where its junctions are.
    """
    if success(episode):
        return True
    broken = (InfractionKind.STOP, InfractionKind.RED_LIGHT)
    ran_sign = any(infraction.kind in broken for infraction in episode.infractions)
    if ability != TRAFFIC_SIGNS or ran_sign:
        return False
    # A failed route obeyed its signs if the ego came far enough into the junction
    if episode.given is not None:
        return None if episode.completion_percent > 0.0 else False
    if episode.junction_m is None:
        return False
    passed_m = episode.completion_percent / 100.0 * episode.route_length_m
    return passed_m > episode.junction_m + JUNCTION_MARGIN_M
