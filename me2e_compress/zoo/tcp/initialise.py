"""Build TCP with weights from a seed, calibrated on images of three cameras."""

import torch

from me2e_compress.zoo.drawing import Gains, draw_weights, one_thread, take_statistics
from me2e_compress.zoo.stacks import TCP
from me2e_compress.zoo.synthetic_frames import frames
from me2e_compress.zoo.tcp.config import ActionHeads
from me2e_compress.zoo.tcp.stack import Tcp

GAINS = Gains(
    by_name=(
        (r"weight_(ih|hh)|action_head|dist_", 1.0),
        (r"output_traj", 1.0),
    ),
    last_norm=r"layer\d\.\d\.bn2\.weight$",
)

CALIBRATION_FRAMES = 4
CALIBRATION_STRIDE = 2
"""Every second pixel is enough for the statistics of a channel."""


def build_tcp(*, seed: int = 0, heads: ActionHeads = "bench2drive") -> Tcp:
    """Build and initialise; the same seed gives the same bytes."""
    model = Tcp(heads).requires_grad_(False).eval()
    draw_weights(model, GAINS, seed)
    step = CALIBRATION_STRIDE
    made = frames(TCP, CALIBRATION_FRAMES, seed, scene_length=1)
    seen = [torch.from_numpy(frame["img"])[:, :, ::step, ::step] for frame in made]
    with one_thread():
        take_statistics(model.perception, torch.cat(seen))
    return model
