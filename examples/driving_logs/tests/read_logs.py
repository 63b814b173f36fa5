"""A model for the small logs, and what it reads of them."""

import numpy as np

from driving_logs.model_inputs import (
    InputForm,
    LoggedInputs,
    log_frames,
)
from driving_logs.moments import CameraLog
from me2e_compress.calibration.dataset import PixelInput
from me2e_compress.calibration.recording import LOGS
from me2e_compress.runtime.frames import Frame
from small_logs import LIDAR_M

F32 = np.dtype(np.float32)
FORMS = {
    "img": InputForm((1, 6, 3, 64, 80), F32),
    "lidar2img": InputForm((1, 6, 4, 4), F32),
    "can_bus": InputForm((18,), F32),
    "command": InputForm((1,), np.dtype(np.int64)),
    "timestamp": InputForm((1,), F32),
    "l2g_r_mat": InputForm((3, 3), F32),
    "l2g_t": InputForm((3,), F32),
}
PIXELS = PixelInput(mean=(0, 0, 0), std=(1, 1, 1), order="rgb", rows=64, columns=80)
MODEL = LoggedInputs(FORMS, PIXELS)
"""Half the pictures' 160 x 90, padded to 64 rows."""


def opened(text: str) -> CameraLog:
    log = LOGS.parse(text)
    assert isinstance(log, CameraLog)
    return log


def frames(log: CameraLog, model: LoggedInputs = MODEL, count: int = 99) -> list[Frame]:
    return list(log_frames(log, model, count))


def to_lidar(car: np.ndarray) -> np.ndarray:
    """From the car (x forward, y left) to its lidar (x right, y forward)."""
    x, y, z = car[:3] - LIDAR_M
    return np.array([-y, x, z, 1.0])
