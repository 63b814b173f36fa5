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

from collections.abc import Sequence
from statistics import fmean

import numpy as np

from me2e_compress.metrics.episode import EgoFrame, Episode, InfractionKind
from me2e_compress.metrics.measure import Estimate, Measure, binomial_interval
from me2e_compress.metrics.route_scores import (
    CHECKPOINTS,
    DONE_PERCENT,
    OUTLIER_PERCENT,
    PERCENT,
    WINDOW,
    Floats,
    beside_traffic,
    filtered,
)

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
    return episode.given.status in SUCCESSES and all(
        infraction.kind is InfractionKind.MIN_SPEED
        for infraction in episode.infractions
    )


def efficiency(episode: Episode) -> Measure:
    """Return the mean percentage of the check points that are at most 1000 %."""
    kept = [ratio for ratio in speed_ratios(episode) if ratio <= OUTLIER_PERCENT]
    if not kept:
        return Measure(None, PERCENT, "no check point below 1000 %")
    return Measure(fmean(kept), PERCENT)


def speed_ratios(episode: Episode) -> tuple[float, ...]:
    """Return the percentages that MinimumSpeedRouteTest would have reported.

    A check point is reached when more than a twentieth of the route, counted in whole
    metres, was passed since the last one; the rest counts if more than 95 % is done.
    """
    if episode.speed_ratios_percent is not None:
        return episode.speed_ratios_percent
    spacing_m = episode.route_length_m / CHECKPOINTS
    ratios, passed_m, stretch = list[float](), 0, list[EgoFrame]()
    for frame in episode.frames:
        stretch.append(frame)
        if int(frame.route_m) - passed_m > spacing_m:
            ratios.append(_percent(stretch))
            passed_m, stretch = int(frame.route_m), []
    if episode.completion_percent > DONE_PERCENT:
        ratios += 2 * [_percent(stretch)]
    return tuple(ratios)


def _percent(stretch: list[EgoFrame]) -> float:
    ego, traffic, count = beside_traffic(stretch)
    if traffic == 0.0:
        return 100.0
    return round(100.0 * (ego / count) / (traffic / count), 2)


def smoothness(episode: Episode) -> Measure:
    """Return the share of smooth blocks of 20 frames ("Driving Smoothness").

    Up to 20 frames form one block; with fewer than 3 the original raises an error.
    """
    frames = episode.frames
    if len(frames) < 3:
        return Measure(None, "ratio", f"{len(frames)} frames, 3 are needed")
    # Columns [4, N]: along, across, norm, yaw rate in degrees per second
    rows = list[tuple[float, ...]]()
    for frame in frames:
        along, across = frame.acceleration_mps2, frame.lateral_acceleration_mps2
        norm = frame.acceleration_norm_mps2
        norm = float(np.hypot(along, across)) if norm is None else norm
        rows.append((along, across, norm, float(np.degrees(frame.yaw_rate_radps))))
    columns = np.array(rows).T
    # Whole blocks only; the rest is dropped
    length = min(len(frames), BLOCK_FRAMES)
    blocks = len(frames) // length
    cut = columns[:, : blocks * length].reshape(len(columns), blocks, length)
    a_along, a_across, a_length = map(_smoothed, cut[:3])
    # As the original: degrees are unwrapped as if they were radians
    turns = np.round(np.diff(cut[3]) / (2.0 * np.pi)).cumsum(axis=1)
    turned = np.pad(turns, ((0, 0), (1, 0)))
    yaw_rate = _smoothed(cut[3] - 2.0 * np.pi * turned)
    # The last bound is in radians; the original's yaw acceleration is the yaw rate, of
    # which it asks less than 1.93 too
    within = (
        (a_along > -4.05) & (a_along < 2.40),
        np.abs(a_across) < 4.89,
        np.abs(_smoothed(a_length, 1)) < 8.37,
        np.abs(_smoothed(a_along, 1)) < 4.13,
        np.abs(yaw_rate) < 0.95,
    )
    smooth = np.logical_and.reduce(within).all(axis=1)
    return Measure(fmean(smooth.tolist()), "ratio")


def _smoothed(values: Floats, derivative: int = 0) -> Floats:
    """Smooth every row of [B, N] on its own."""
    return filtered(values, DELTA_S, derivative, min(WINDOW, values.shape[1]))


# Bench2Drive's five abilities. A route counts under every ability that it tests; routes
# without a record are not counted. For Traffic_Signs a route also counts that failed,
# but *passed the junction*: the ego came more than 8 m into it and ran no stop sign or
# red light (tools/ability_benchmark.py, branch 0.0.4).


ABILITIES = ("Overtaking", "Merging", "Emergency_Brake", "Give_Way", "Traffic_Signs")
TRAFFIC_SIGNS = "Traffic_Signs"

JUNCTION_MARGIN_M = 8.0
"""How far past the start of a junction the ego must come to have obeyed its signs."""


def mastered(episode: Episode, ability: str) -> bool:
    """Return whether a route of ours counts as a success for one of its abilities."""
    if episode.succeeded:
        return True
    if ability != TRAFFIC_SIGNS or episode.junction_m is None:
        return False
    passed_m = episode.completion_percent / 100.0 * episode.route_length_m
    inside = passed_m > episode.junction_m + JUNCTION_MARGIN_M
    return inside and not _ran_a_sign(episode)


def successes(episodes: Sequence[Episode]) -> dict[str, tuple[bool, ...]]:
    """Return, for each ability, whether each route that tests it was mastered."""
    outcomes = dict[str, tuple[bool, ...]]()
    for name in ABILITIES:
        tested = (episode for episode in episodes if name in episode.abilities)
        outcomes[name] = tuple(mastered(episode, name) for episode in tested)
    return outcomes


def ability_rates(episodes: Sequence[Episode]) -> tuple[Estimate, dict[str, Estimate]]:
    """Return the mean of the abilities' rates of a real run in percent, and each rate.

    A real run does not say where junctions are. Where that decides, the rate of
    Traffic_Signs is None, and so is the mean.
    """
    rates = dict[str, Estimate]()
    for ability in ABILITIES:
        won = [success(one) for one in episodes if ability in one.abilities]
        if not won:
            rates[ability] = Estimate.missing("%", "no such route was driven")
            continue
        measure = Measure(100.0 * sum(won) / len(won), "%")
        interval = binomial_interval(sum(won), len(won))
        rates[ability] = Estimate(measure, *interval, len(won))
    # Failed routes that would count if the ego passed their junction
    tested = [one for one in episodes if TRAFFIC_SIGNS in one.abilities]
    begun = [one for one in tested if one.completion_percent > 0.0]
    unknown = [one.route for one in begun if not (success(one) or _ran_a_sign(one))]
    if unknown:
        others = f" and {len(unknown) - 1} others" if len(unknown) > 1 else ""
        reason = f"where the junction is on {unknown[0]}{others} is not known"
        rates[TRAFFIC_SIGNS] = Estimate.missing("%", reason, len(tested))
    # The mean, if all five are known
    lacks = [name for name, rate in rates.items() if rate.value is None]
    if lacks:
        reason = f"{lacks[0]}: {rates[lacks[0]].measure.reason}"
        return Estimate.missing("%", reason, len(episodes)), rates
    mean = fmean(rate.value or 0.0 for rate in rates.values())
    return Estimate(Measure(mean, "%"), None, None, len(episodes)), rates


def _ran_a_sign(episode: Episode) -> bool:
    broken = (InfractionKind.STOP, InfractionKind.RED_LIGHT)
    return any(infraction.kind in broken for infraction in episode.infractions)
