"""Bench2Drive's own arithmetic, to the digit, kept apart from ours.

What its tools compute (tools/efficiency_smoothness_benchmark.py, branches 0.0.3 and
0.0.4) differs from what their names say; the published tables were made with it, so
it is repeated here, faults included:

* comfort compares degrees per second with a bound in radians per second, never takes
  the derivative of the yaw rate that it calls yaw acceleration, differentiates with
  0.1 s where frames are 0.05 s apart, smooths every block of 20 frames on its own and
  the jerk twice, and takes the derivative of the length of the acceleration;
* efficiency writes 100 % at check points without traffic and counts the last one
  twice.
"""

from statistics import fmean
from typing import Any

import numpy as np
import numpy.typing as npt

from me2e_compress.metrics.efficiency import (
    CHECKPOINTS,
    DONE_PERCENT,
    OUTLIER_PERCENT,
    PERCENT,
)
from me2e_compress.metrics.episode import EgoFrame, Episode
from me2e_compress.metrics.infraction import InfractionKind
from me2e_compress.metrics.measure import Measure

BLOCK_FRAMES = 20
DELTA_S = 0.1
SUCCESSES = ("Completed", "Perfect")

Floats = npt.NDArray[np.float64]


def success(episode: Episode) -> bool:
    """Return whether a record counts as a success (tools/merge_route_json.py).

    Its status is Completed or Perfect, and every list of infractions but that of low
    speed is empty; without a status this is `Episode.succeeded`.
    """
    if episode.given is None:
        return episode.succeeded
    return episode.given.status in SUCCESSES and all(
        each.kind is InfractionKind.MIN_SPEED for each in episode.infractions
    )


def efficiency(episode: Episode) -> Measure:
    """Return the mean of the check points' percentages that are at most 1000 %."""
    kept = [ratio for ratio in speed_ratios(episode) if ratio <= OUTLIER_PERCENT]
    if not kept:
        return Measure(None, PERCENT, "no check point below 1000 %")
    return Measure(fmean(kept), PERCENT)


def speed_ratios(episode: Episode) -> tuple[float, ...]:
    """Return the percentages that MinimumSpeedRouteTest would have reported.

    A check point is reached when more than a twentieth of the route, counted in whole
    metres, was passed since the last; the rest counts if more than 95 % is done.
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
    seen = [
        (frame.speed_mps, frame.traffic_speed_mps)
        for frame in stretch
        if frame.traffic_speed_mps is not None
    ]
    traffic = sum(traffic for _, traffic in seen)
    if traffic == 0.0:
        return 100.0
    mean_ego = sum(ego for ego, _ in seen) / len(seen)
    return round(100.0 * mean_ego / (traffic / len(seen)), 2)


def smoothness(episode: Episode) -> Measure:
    """Return the share of smooth blocks of 20 frames ("Driving Smoothness").

    Up to 20 frames are one block; fewer than 3 stop the original with an error.
    """
    frames = episode.frames
    if len(frames) < 3:
        return Measure(None, "ratio", f"{len(frames)} frames, 3 are needed")
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
    length = min(len(frames), BLOCK_FRAMES)
    blocks = len(frames) // length
    cut = columns[:, : blocks * length].reshape(len(columns), blocks, length)
    return Measure(fmean(smooth_blocks(*cut).tolist()), "ratio")


def smooth_blocks(
    along: Floats, across: Floats, length: Floats, yaw_rate_degps: Floats
) -> npt.NDArray[np.bool_]:
    """Return [B] whether all samples of a block lie within the bounds.

    Args:
        along: [B, N] acceleration along the heading, m/s2.
        across: [B, N] acceleration across it, m/s2.
        length: [B, N] length of the acceleration in the plane, m/s2.
        yaw_rate_degps: [B, N] degrees per second.
    """
    a_along, a_across, a_length = map(_smoothed, (along, across, length))
    turns = np.round(np.diff(yaw_rate_degps) / (2.0 * np.pi)).cumsum(axis=1)
    turned = np.pad(turns, ((0, 0), (1, 0)))
    yaw_rate = _smoothed(yaw_rate_degps - 2.0 * np.pi * turned)
    yaw_acceleration = yaw_rate
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
    from scipy.signal import savgol_filter  # takes half a second to import

    window = min(7, values.shape[1])
    smoothed: Any = savgol_filter(values, window, 2, deriv=derivative, delta=DELTA_S)
    return np.asarray(smoothed, np.float64)
