"""UniAD in small: the same classes, fewer pixels, cells, queries and slots."""

import functools

import numpy as np
import torch
from numpy.typing import NDArray

from models.bev.sizes import BevGrid, Sampling
from models.stacks import Stack, uniad_stack
from models.uniad.config import RANGE, UniadConfig
from models.uniad.initialise import initialise
from models.uniad.stack import UniadTiny

Arrays = dict[str, NDArray[np.float32 | np.int64]]

SMALL = UniadConfig(
    image_hw=(64, 96),
    stem=8,
    grid=BevGrid((12, 12), RANGE, (12.0, 12.0)),
    queries=31,
    tracks=8,
    encoder_layers=1,
    decoder_layers=2,
    map_queries=5,
)


def small_spec() -> Stack:
    """The interface of the stack at these sizes."""
    return uniad_stack("uniad-tiny", SMALL, scale=1.0, straight_on=3)


@functools.cache
def small_uniad(sampling: Sampling = "operator") -> UniadTiny:
    """The stack at these sizes, of seed 0."""
    model = UniadTiny(SMALL, sampling).requires_grad_(False).eval()
    (frame,) = small_frames(1)
    images, cameras = (torch.from_numpy(frame[n]) for n in ("img", "lidar2img"))
    initialise(model, images[0], cameras, seed=0, beginning=0.3)
    return model


def small_frames(count: int) -> list[Arrays]:
    """Frames of a vehicle that drives straight on, in front of noise."""
    rng = np.random.default_rng(0)
    still = rng.standard_normal(small_spec().inputs["img"], dtype=np.float32)
    projection = np.eye(4, dtype=np.float32)
    projection[:3, :3] = [[60, 48, 0], [0, 32, -60], [0, 1, 0]]
    frames = []
    for step in range(count):
        moved = rng.standard_normal(still.shape, dtype=np.float32)
        bus = np.zeros(18, np.float32)
        bus[1], bus[16], bus[17] = 2.5, 0.1 * step, 3.0
        frames.append(
            {
                "img": still + 0.5 * moved,
                "lidar2img": np.tile(projection, (1, 6, 1, 1)),
                "can_bus": bus,
                "command": np.array([step % 6]),
                "l2g_r_mat": np.eye(3, dtype=np.float32)[None],
                "l2g_t": np.array([[0, 2.5 * step, 1.8]], np.float32),
                "timestamp": np.array([step / 2], np.float32),
            }
        )
    return frames


def nothing_before() -> Arrays:
    """The state at the start of a scene."""
    spec = small_spec()
    return {
        name: np.zeros(spec.inputs[name], spec.dtypes.get(name, "float32"))
        for name in spec.recurrent
    }
