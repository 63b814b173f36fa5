"""Ego recordings of agents, ``metric_info.json``, as frames.

For every step, Bench2Drive's agents write acceleration (m/s2, world), angular velocity
(degrees per second), forward and right vector, location (m) and rotation (degrees), in
CARLA's left-handed world. They write no time; it follows from the route's duration.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from me2e_compress.base import documents
from me2e_compress.metrics.episode import LARGEST, EgoFrame, InferenceRecord

TICK_S = 0.05  # simulated seconds between two ticks of a leaderboard run
# Intervals of agents: UniAD, VAD, TCP every tick, ADMLP every tenth
INTERVALS_S = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0)

_PARTS = ("acceleration", "angular_velocity", "forward_vector", "right_vector")
_LOCATION = "location"
_STEP = re.compile(r"-?\d{1,15}")
_EQUALS = float(np.log(1.1))

Floats = npt.NDArray[np.float64]


class BrokenRecordingError(ValueError):
    """A recording is incomplete; the message is one line, without the file name."""


@dataclass(frozen=True)
class RecordedRoute:
    """One recording in our conventions: x east, y north, angles counter-clockwise."""

    steps: npt.NDArray[np.int64]  # (n,) the agent's own counts, in the file's order
    position_m: Floats  # (n, 2) in the world
    acceleration_mps2: Floats  # (n, 2) in the world
    heading_rad: Floats  # (n,) unwrapped
    yaw_rate_radps: Floats  # (n,)
    along_mps2: Floats  # (n,) acceleration in the ego's frame
    left_mps2: Floats  # (n,)

    @property
    def in_order(self) -> bool:
        """Whether the steps are strictly increasing."""
        return bool((np.diff(self.steps) > 0).all())

    def frames(self, interval_s: float) -> tuple[EgoFrame, ...]:
        """Return one frame per step; ``route_m`` is the distance driven."""
        # One column per field of a frame
        moved = _lengths(np.diff(self.position_m, axis=0))
        speeds = np.zeros(len(self.steps))
        if len(speeds) > 1:
            speeds = _lengths(np.gradient(self.position_m, interval_s, axis=0))
        columns = {
            "x": self.position_m[:, 0],
            "y": self.position_m[:, 1],
            "heading": self.heading_rad,
            "speed_mps": speeds,
            "acceleration_mps2": self.along_mps2,
            "lateral_acceleration_mps2": self.left_mps2,
            "yaw_rate_radps": self.yaw_rate_radps,
            "route_m": np.concatenate([[0.0], moved.cumsum()]),
            "acceleration_norm_mps2": _lengths(self.acceleration_mps2),
        }
        frames = list[EgoFrame]()
        unknown: dict[str, Any] = {"steering_rad": None, "traffic_speed_mps": None}
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        for index, row in enumerate(rows):
            own = dict(zip(columns, row, strict=True)) | unknown
            frames.append(EgoFrame(time_us=round(1e6 * interval_s * index), **own))
        return tuple(frames)

    def interval_s(self, duration_s: float | None = None) -> float:
        """Return the seconds from one step to the next.

        That is the usual interval within 10 % of duration over steps, else the median
        number of ticks.
        """
        if duration_s is not None:
            mean_s = duration_s / len(self.steps)
            away, nearest = min((abs(np.log(s / mean_s)), s) for s in INTERVALS_S)
            if away < _EQUALS:
                return nearest
        between = np.diff(self.steps)
        ticks = float(np.median(between)) if between.size else 1.0
        return TICK_S * max(1.0, min(ticks, 20.0))


def _lengths(vectors: Any) -> Floats:
    return np.asarray(np.hypot(vectors[:, 0], vectors[:, 1]))


def read_recording(raw: object) -> RecordedRoute:
    """Read a parsed ``metric_info.json``; its numbers may be infinite or NaN."""
    # Check that steps are keyed by their number
    if not isinstance(raw, dict) or not raw:
        raise BrokenRecordingError("no step is recorded")
    steps = [key for key in raw if not _STEP.fullmatch(key)]
    if steps:
        raise BrokenRecordingError(f"{steps[0][:60]!r} is not the number of a step")
    # Turn CARLA's left-handed world into a right-handed one
    acceleration, turning, forward, right = (_column(raw, part) for part in _PARTS)
    location = _column(raw, _LOCATION)
    ahead, aside, push = forward[:, :2], right[:, :2], acceleration[:, :2]
    mirror = np.array([1.0, -1.0])  # CARLA's y points right
    return RecordedRoute(
        np.array([int(key) for key in raw], np.int64),
        location[:, :2] * mirror,
        push * mirror,
        np.unwrap(-np.arctan2(ahead[:, 1], ahead[:, 0])),
        -np.radians(turning[:, 2]),
        np.einsum("ij,ij->i", push, ahead),
        -np.einsum("ij,ij->i", push, aside),
    )


def _column(raw: dict[str, object], part: str) -> Floats:
    """Return [N, 3] a part of every step."""
    rows = list[list[float]]()
    for step, values in raw.items():
        vector = values.get(part) if isinstance(values, dict) else None
        if not isinstance(vector, list) or len(vector) < 3:
            raise BrokenRecordingError(f"step {step}: no {part}")
        if not {type(number) for number in vector} <= {int, float}:
            raise BrokenRecordingError(f"step {step}: {part} is not made of numbers")
        # NaN compares as false
        if not all(abs(number) <= LARGEST for number in vector):
            raise BrokenRecordingError(f"step {step}: {part} is not finite")
        rows.append(vector[:3])
    return np.array(rows, np.float64)


_Count = Annotated[int, Field(ge=0, le=LARGEST)]


class _Line(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")
    frame: _Count
    latency_us: _Count


def read_decisions(path: Path) -> tuple[InferenceRecord, ...]:
    """Read a ``decisions.jsonl``."""
    decisions = list[InferenceRecord]()
    lines = documents.read_bytes(path, documents.LARGEST_LOG_BYTES).splitlines()
    for number, line in enumerate(lines, 1):
        try:
            noted = _Line.model_validate(documents.from_json(line))
        except (documents.MalformedError, ValidationError) as error:
            raise BrokenRecordingError(f"line {number} is no decision") from error
        time_us = round(1e6 * TICK_S * noted.frame)
        decisions.append(InferenceRecord(time_us, noted.latency_us))
    return tuple(decisions)
