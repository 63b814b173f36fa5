"""An episode as arrays."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from me2e_compress.evaluators.highway.observe import cameras_of, can_bus_of
from me2e_compress.simulator.camera_rig import CameraRig
from me2e_compress.simulator.plane_geometry import Floats, RoutePath
from me2e_compress.simulator.scene import Signal, SignalKind, SignalState
from me2e_compress.simulator.world import World
from models.driver.episodes.agents import (
    FUTURE_STEPS,
    FUTURE_US,
    GRID,
    agents,
)
from models.driver.episodes.birdseye import ground_classes
from models.driver.episodes.jpeg import pictures
from models.driver.episodes.recording_policy import LabelledFrame
from models.driver.expert.expert_policy import decide
from models.driver.expert.privileged import Privileged
from models.driver.expert.reentry import beyond

SIGNALS = 4
SIGNAL_COLUMNS = 8
KINDS = {
    SignalKind.TRAFFIC_LIGHT: 0.0,
    SignalKind.STOP_SIGN: 1.0,
    SignalKind.GIVE_WAY: 2.0,
}
STATES = {
    SignalState.RED: 0.0,
    SignalState.YELLOW: 1.0,
    SignalState.GREEN: 2.0,
    None: -1.0,
}


def signals(frame: LabelledFrame, ego_s_m: float) -> npt.NDArray[np.float32]:
    """Return float32 [4, 8], a row for each signal around the ego.

    Columns: kind, state, x, y, cosine, sine, metres to the line, served.

    Signals on the route come first, then the nearest. Kind and state are -1 where
    there is none, the metres NaN where the route does not meet the line.

    Args:
        frame: When.
        ego_s_m: Arc length of the ego.
    """
    ego = frame.scene.ego
    gaps = {phase.signal_id: phase.line_s - ego_s_m for phase in frame.phases}

    def rank(signal: Signal) -> tuple[bool, float]:
        away = math.hypot(signal.x - ego.x, signal.y - ego.y)
        return signal.id not in gaps, away

    rows = np.zeros((SIGNALS, SIGNAL_COLUMNS), np.float32)
    rows[:, :2], rows[:, 6] = -1.0, np.nan
    for row, signal in enumerate(sorted(frame.scene.signals, key=rank)[:SIGNALS]):
        x, y = ego.seen(np.array(signal.x), np.array(signal.y))
        turn = signal.heading - ego.heading
        rows[row] = (
            *(KINDS[signal.kind], STATES[signal.state], x, y),
            *(math.cos(turn), math.sin(turn), gaps.get(signal.id, math.nan)),
            signal.id in frame.decision.memory.served,
        )
    return rows


Arrays = dict[str, npt.NDArray[Any]]

STANDING_MPS = 0.1
"""Slower than this stands, as for Bench2Drive's stop signs."""
LONGEST_REST_S = 60.0
PATH_M: Floats = np.arange(0.0, 50.0, 2.0)
"""Where the route ahead is sampled."""


def arrays_of(
    world: World,
    top: Floats,
    frames: Sequence[LabelledFrame],
    every: int,
    image_size: tuple[int, int],
) -> Arrays:
    """Return the arrays of every ``every``-th frame, see the package.

    Args:
        world: That was driven in.
        top: [N] speed ceiling along its route.
        frames: All of them, from the first one on.
        every: Frames between two samples.
        image_size: Rows and columns of a camera.
    """
    cameras = cameras_of(world, CameraRig(*image_size))
    chosen = range(0, len(frames), every)
    rests = list(_rests(frames))
    later = FUTURE_US // world.dt_us
    samples = list[Arrays]()
    for i in chosen:
        ahead = [i + later * (step + 1) for step in range(FUTURE_STEPS)]
        future = [frames[j].scene if j < len(frames) else None for j in ahead]
        samples.append(
            {
                **_state(frames[i]),
                "rest_s": np.array(rests[i], np.float32),
                **_route(frames[i], world.path, top),
                **agents(frames[i].scene, future),
                "ground": ground_classes(frames[i].scene.ego, cameras.texture, GRID),
            }
        )
    images = pictures(cameras, [frames[i].scene for i in chosen])
    return images | {
        name: np.stack([sample[name] for sample in samples]) for name in samples[0]
    }


def _state(frame: LabelledFrame) -> Arrays:
    """Return the ego's state and the expert's label."""
    ego = frame.scene.ego
    return {
        "time_us": np.array(frame.scene.time_us, np.int64),
        "pose": np.array([ego.x, ego.y, ego.heading]),
        "can_bus": can_bus_of(ego, None),
        "command": np.array(frame.command, np.int64),
        "plan": frame.decision.waypoints.astype(np.float32),
        "target_m": np.array(frame.decision.target_m, np.float32),
    }


def _route(frame: LabelledFrame, path: RoutePath, top: Floats) -> Arrays:
    """Return the route ahead, the expert's plan without actors, and the signals."""
    scene, ego = frame.scene, frame.scene.ego
    s, lateral = path.project(ego.x, ego.y, frame.memory.at_m)
    alone = decide(
        replace(scene, actors=()),
        Privileged((), frame.phases),
        path,
        top,
        frame.memory,
    )
    x, y, _ = beyond(path, s + PATH_M, np.zeros_like(PATH_M))
    columns = (path.left_m, path.right_m, path.oncoming_m, top)
    attributes = [path.value(column, s + PATH_M) for column in columns]
    return {
        "plan_alone": alone.waypoints.astype(np.float32),
        "lateral_m": np.array(lateral, np.float32),
        "path": ego.seen(x, y).astype(np.float32),
        "path_attributes": np.stack(attributes, axis=-1).astype(np.float32),
        "signals": signals(frame, s),
    }


def _rests(frames: Sequence[LabelledFrame]) -> Iterator[float]:
    """Yield the seconds since the ego last stood, at every frame."""
    stood_us: int | None = None
    for frame in frames:
        now = frame.scene.time_us
        if frame.scene.ego.speed_mps < STANDING_MPS:
            stood_us = now
        since = LONGEST_REST_S if stood_us is None else (now - stood_us) / 1e6
        yield min(since, LONGEST_REST_S)
