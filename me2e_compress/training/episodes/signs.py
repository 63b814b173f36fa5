"""Lights and signs around the ego."""

import math

import numpy as np
import numpy.typing as npt

from me2e_compress.evaluators.highway.reference import in_ego_frame
from me2e_compress.simulator.scene import Signal, SignalKind, SignalState
from me2e_compress.training.episodes.recording_policy import LabelledFrame

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
    """float32 [4, 8]: kind, state, x, y, cosine, sine, metres to the line, served.

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
        x, y = in_ego_frame(np.array(signal.x), np.array(signal.y), ego)
        turn = signal.heading - ego.heading
        rows[row] = (
            *(KINDS[signal.kind], STATES[signal.state], x, y),
            *(math.cos(turn), math.sin(turn), gaps.get(signal.id, math.nan)),
            signal.id in frame.decision.memory.served,
        )
    return rows
