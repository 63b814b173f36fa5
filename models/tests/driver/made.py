"""Episodes that nobody drove, in the shapes of those that were."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from models.driver.episodes import GRID
from models.driver.episodes.jpeg import encode
from models.driver.network.config import HighwayConfig
from models.driver.stored_episode import KEPT

Arrays = dict[str, npt.NDArray[Any]]

SIZE = (96, 160)
LITTLE = HighwayConfig(stages=(8, 8, 8, 8), anchors=6, agents=8)
"""As wide as the exported driver must be, and no wider."""


def arrays_of(
    samples: int, seed: int = 0, size: tuple[int, int] = SIZE, every_s: float = 0.2
) -> Arrays:
    """An ego that goes 5 m/s straight on, two cars, a light, noise on six cameras."""
    rng = np.random.default_rng(seed)
    arrays: Arrays = {
        name: np.zeros((samples, *shape), np.float32) for name, shape in KEPT.items()
    }
    steps, times = np.arange(samples), 0.5 * np.arange(1, 7)
    arrays["time_us"] = (steps * every_s * 1e6).astype(np.int64)
    arrays["pose"] = np.stack([5 * every_s * steps, 0 * steps, 0 * steps], -1)
    arrays["can_bus"][:, 7] = 5.0
    arrays["command"] = np.full(samples, 3)
    arrays["rest_s"][:] = 60.0
    arrays["plan"][..., 0] = arrays["plan_alone"][..., 0] = 5 * times
    arrays["path"][..., 0] = 2.0 * np.arange(25)
    arrays["path_attributes"][:] = (1.75, 5.25, 1.75, 8.0)
    arrays["agents"][..., 0] = -1
    arrays["agents"][:, 0] = (0, 20, 0.5, 1, 0, 4.6, 1.9, 5, 0, 0)
    arrays["agents"][:, 1] = (0, 9, -3.5, 0, -1, 4.6, 1.9, 0, -2, 0)
    arrays["futures"][:] = np.nan
    arrays["futures"][:, 0] = np.stack([20 + 5 * times, np.full(6, 0.5)], -1)
    arrays["futures"][:, 1] = np.stack([np.full(6, 9.0), -3.5 - 2 * times], -1)
    arrays["signals"][..., :2], arrays["signals"][..., 6] = -1, np.nan
    arrays["signals"][:, 0] = (0, 0, 18, 2, 1, 0, 15, 0)
    arrays["ground"] = rng.integers(1, 7, (samples, GRID.rows, GRID.columns), np.uint8)
    arrays["occupancy"] = rng.integers(0, 256, arrays["occupancy"].shape, np.uint8)
    arrays["known_steps"] = np.full(samples, 6)
    looks = [encode(rng.integers(0, 256, (6, *size, 3), np.uint8)) for _ in steps]
    arrays["jpeg"] = np.concatenate(looks)
    arrays["jpeg_offsets"] = np.cumsum([0, *(len(look) for look in looks)])
    return arrays


def write(path: Path, arrays: Arrays) -> Path:
    np.savez(path, allow_pickle=False, **arrays)
    return path
