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
import numpy.typing as npt

from me2e_compress.metrics.comfort import WINDOW, Floats, filtered
from me2e_compress.metrics.efficiency import (
    CHECKPOINTS,
    DONE_PERCENT,
    OUTLIER_PERCENT,
    PERCENT,
    beside_traffic,
)
from me2e_compress.metrics.episode import EgoFrame, Episode
from me2e_compress.metrics.infraction import InfractionKind
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
    return episode.given.status in SUCCESSES and all(
        each.kind is InfractionKind.MIN_SPEED for each in episode.infractions
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
    # columns [4, N]: along, across, norm, yaw rate in degrees per second
    columns = np.array(
        [
            (
                frame.acceleration_mps2,
                frame.lateral_acceleration_mps2,
                _norm(frame),
                np.degrees(frame.yaw_rate_radps),
            )
            for frame in frames
        ]
    ).T
    # whole blocks only; the rest is dropped
    length = min(len(frames), BLOCK_FRAMES)
    blocks = len(frames) // length
    cut = columns[:, : blocks * length].reshape(len(columns), blocks, length)
    return Measure(fmean(smooth_blocks(*cut).tolist()), "ratio")


def smooth_blocks(
    along: Floats, across: Floats, length: Floats, yaw_rate_degps: Floats
) -> npt.NDArray[np.bool_]:
    """Return [B] whether all samples of a block lie within the bounds.

    All arguments are [B, N]: the acceleration along the heading, across it and its norm
    in the plane (m/s2), and the yaw rate in degrees per second.
    """
    # as the original: degrees are unwrapped as if they were radians
    a_along, a_across, a_length = map(_smoothed, (along, across, length))
    turns = np.round(np.diff(yaw_rate_degps) / (2.0 * np.pi)).cumsum(axis=1)
    turned = np.pad(turns, ((0, 0), (1, 0)))
    yaw_rate = _smoothed(yaw_rate_degps - 2.0 * np.pi * turned)
    yaw_acceleration = yaw_rate
    # the last two bounds are in radians, the yaw rate is in degrees
    within = (
        (a_along > -4.05) & (a_along < 2.40),
        np.abs(a_across) < 4.89,
        np.abs(_smoothed(a_length, 1)) < 8.37,
        np.abs(_smoothed(a_along, 1)) < 4.13,
        np.abs(yaw_acceleration) < 1.93,
        np.abs(yaw_rate) < 0.95,
    )
    return np.asarray(np.logical_and.reduce(within).all(axis=1))


def _norm(frame: EgoFrame) -> float:
    if frame.acceleration_norm_mps2 is not None:
        return frame.acceleration_norm_mps2
    return float(np.hypot(frame.acceleration_mps2, frame.lateral_acceleration_mps2))


def _smoothed(values: Floats, derivative: int = 0) -> Floats:
    """Smooth every row of [B, N] on its own."""
    return filtered(values, DELTA_S, derivative, min(WINDOW, values.shape[1]))
