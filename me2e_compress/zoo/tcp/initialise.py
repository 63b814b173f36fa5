"""Draw weights of TCP, calibrated on images of three cameras."""

from torch import Tensor

from me2e_compress.zoo.drawing import Gains, draw_weights, one_thread, take_statistics
from me2e_compress.zoo.tcp.stack import Tcp

GAINS = Gains(
    by_name=(
        (r"weight_(ih|hh)|action_head|dist_", 1.0),
        (r"output_traj", 1.0),
    ),
    last_norm=r"layer\d\.\d\.bn2\.weight$",
)


def initialise(model: Tcp, images: Tensor, seed: int) -> None:
    """Draw parameters, then statistics of images [N, 3, H, W], normalised, in place."""
    draw_weights(model, GAINS, seed)
    with one_thread():
        take_statistics(model.perception, images)
