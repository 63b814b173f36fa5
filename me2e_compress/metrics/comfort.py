"""Driving comfort: the share of seconds with every variable in its range."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from me2e_compress.metrics.episode import FRAME_US, EgoFrame, Ending, Episode
from me2e_compress.metrics.measure import Measure

SEGMENT_FRAMES = 20
WINDOW = 7
ORDER = 2
BLOCKED_SPEED_MPS = 0.1
BLOCKED_US = 60_000_000

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of the six variables, in SI units (the paper's table 1).

    They are the 99th percentiles of human drivers that nuPlan's comfort metric uses.
    """

    lowest_acceleration_mps2: float = -4.05
    highest_acceleration_mps2: float = 2.40
    lateral_acceleration_mps2: float = 4.89
    yaw_rate_radps: float = 0.95
    yaw_acceleration_radps2: float = 1.93
    longitudinal_jerk_mps3: float = 4.13
    jerk_mps3: float = 8.37


BOUNDS = Bounds()


def comfort(episode: Episode, bounds: Bounds = BOUNDS) -> Measure:
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
    return Measure(float(_segments(smooth_frames(episode, bounds)).mean()), "ratio")


def comfort_in_motion(episode: Episode, bounds: Bounds = BOUNDS) -> Measure:
    """Return the comfort over the segments in which the ego moved.

    A standing ego is comfortable, so a driver that is stuck for most of a route scores
    well by `comfort`. Here a segment counts only if the ego was faster than 0.1 m/s in
    at least one of its frames.
    """
    if len(episode.frames) < SEGMENT_FRAMES:
        return comfort(episode, bounds)
    moved = ~_segments(~_moving(episode.frames))
    if not moved.any():
        return Measure(None, "ratio", "the ego never moved")
    return Measure(
        float(_segments(smooth_frames(episode, bounds))[moved].mean()), "ratio"
    )


def standing_share(episode: Episode) -> float | None:
    """Return the share of frames in which the ego stood; None without frames."""
    if not episode.frames:
        return None
    return float(1.0 - _moving(episode.frames).mean())


def stood_most(episodes: Iterable[Episode]) -> tuple[str, ...]:
    """Return the routes on which the ego stood for more than half of the frames."""
    return tuple(one.route for one in episodes if (standing_share(one) or 0.0) > 0.5)


def frame_interval_us(frames: Sequence[EgoFrame]) -> int:
    """Return the median interval between two frames, in microseconds."""
    if len(frames) < 2:
        return FRAME_US
    times_us = np.array([frame.time_us for frame in frames])
    return int(np.median(np.diff(times_us))) or FRAME_US


def _segments(smooth: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    segments = len(smooth) // SEGMENT_FRAMES
    cut = smooth[: segments * SEGMENT_FRAMES].reshape(segments, SEGMENT_FRAMES)
    return np.asarray(cut.all(axis=1))


def _moving(frames: Sequence[EgoFrame]) -> npt.NDArray[np.bool_]:
    return np.array([frame.speed_mps > BLOCKED_SPEED_MPS for frame in frames])


def smooth_frames(episode: Episode, bounds: Bounds = BOUNDS) -> npt.NDArray[np.bool_]:
    """Return for each of at least 7 frames whether all six variables are in range."""
    frames = episode.frames
    # the jerk needs the acceleration vector in the world
    along = np.array([frame.acceleration_mps2 for frame in frames])
    left = np.array([frame.lateral_acceleration_mps2 for frame in frames])
    heading = np.array([frame.heading for frame in frames])
    yaw_rate = np.array([frame.yaw_rate_radps for frame in frames])
    east = along * np.cos(heading) - left * np.sin(heading)
    north = along * np.sin(heading) + left * np.cos(heading)
    delta_s = frame_interval_us(frames) / 1e6
    # every variable against its bounds
    acceleration = _filtered(along)
    jerk_east, jerk_north = (_filtered(each, delta_s, 1) for each in (east, north))
    return (
        (acceleration >= bounds.lowest_acceleration_mps2)
        & (acceleration <= bounds.highest_acceleration_mps2)
        & (np.abs(_filtered(left)) <= bounds.lateral_acceleration_mps2)
        & (np.abs(_filtered(yaw_rate)) <= bounds.yaw_rate_radps)
        & (np.abs(_filtered(yaw_rate, delta_s, 1)) <= bounds.yaw_acceleration_radps2)
        & (np.abs(_filtered(along, delta_s, 1)) <= bounds.longitudinal_jerk_mps3)
        & (np.hypot(jerk_east, jerk_north) <= bounds.jerk_mps3)
    ) | _blocked_frames(episode)


def _filtered(values: Floats, delta_s: float = 1.0, derivative: int = 0) -> Floats:
    from scipy.signal import savgol_filter  # takes half a second to import

    smoothed: Any = savgol_filter(
        values, WINDOW, ORDER, deriv=derivative, delta=delta_s
    )
    return np.asarray(smoothed, np.float64)


def _blocked_frames(episode: Episode) -> npt.NDArray[np.bool_]:
    """Mark the frames of every stop of 60 s, and of the stop that ended the route.

    The last one may be a frame short on file: the rule is checked at finer steps.
    """
    still = [frame.speed_mps <= BLOCKED_SPEED_MPS for frame in episode.frames]
    blocked = np.zeros(len(still), np.bool_)
    edges = np.flatnonzero(np.diff([False, *still, False]))
    for start, end in edges.reshape(-1, 2):
        lasted = episode.frames[end - 1].time_us - episode.frames[start].time_us
        ended = end == len(still) and episode.ending is Ending.BLOCKED
        blocked[start:end] = lasted >= BLOCKED_US or ended
    return blocked
