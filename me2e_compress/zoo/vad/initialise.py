"""Draw weights from a seed so that the untrained network reacts to its input.

A network drawn at random loses its input on the way: activations of different images
share a large common part, averages over hundreds of keys cancel, and the plan hardly
changes with a camera. So the statistics of backbone and neck are taken from rendered
frames, residual branches that carry information are stronger than their shortcuts, and
the weights of a linear layer sum to zero, which cancels the common part that a ReLU
leaves. No two tensors are equal and none is constant, as in a trained model: an
exporter merges equal ones.
"""

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.sizes import Sampling
from me2e_compress.zoo.drawing import Gains, draw_weights, one_thread, take_statistics
from me2e_compress.zoo.stacks import VAD_TINY, Stack
from me2e_compress.zoo.synthetic_frames import frames
from me2e_compress.zoo.vad.config import HeadsName
from me2e_compress.zoo.vad.stack import VadTiny

GAINS = (
    (r"ego_(agent|map)_decoder.*attn\.out_proj", 4.0),
    (r"attn\.out_proj", 1.5),
    (r"transformer\..*attn\.in_proj_weight", 1.0),
    (r"attn\.in_proj_weight", 1.2),
    (r"decoder\..*attentions\.1\.output_proj", 1.5),
    (r"attentions\.0\.output_proj", 1.0),
    (r"deformable_attention\.value_proj|attentions\.1\.value_proj", 2.0),
    (r"attentions\.1\.output_proj", 2.5),
    (r"sampling_offsets", 0.6),
    (r"attention_weights|reference_points", 1.2),
    (r"pos_mlp", 2.0),
    (r"reg_branches\.\d\.4", 0.05),
    (r"ffns\.0\.layers\.1", 0.7),
    (r"ego_fut_decoder\.4", 1.0),
)
"""Standard deviation of an output for a unit input, by a pattern in the name.
Found by trial: the tests state what they must achieve. Strong regressions would move
reference points by whole cells at the least noise, so theirs are small."""

CALIBRATION_FRAMES = 4
CALIBRATION_STRIDE = 2
"""Every second pixel is enough for the statistics of a channel."""


def initialise(model: VadTiny, images: Tensor, seed: int) -> None:
    """Draw parameters, then statistics of images [N, 3, H, W], normalised, in place."""
    draw_weights(model, Gains(GAINS, last_norm=r"bn3\.weight$"), seed)
    with one_thread():
        _calibrate(model, images)


def rendered(spec: Stack, seed: int, step: int = 1) -> Tensor:
    """Return images of several scenes, [N, 3, H, W], with every ``step``-th pixel."""
    return torch.cat(
        [
            torch.from_numpy(frame["img"])[0, :, :, ::step, ::step]
            for frame in frames(spec, CALIBRATION_FRAMES, seed, scene_length=1)
        ]
    )


def _calibrate(model: VadTiny, images: Tensor) -> None:
    # The backbone first, then the neck layer by layer
    features = take_statistics(model.img_backbone, images)
    for conv in _convolutions(model.img_neck):
        out = conv(features)
        mean = out.mean((0, 2, 3))
        scale = out.std((0, 2, 3)).reciprocal()
        bias = conv.bias
        if bias is None:
            raise TypeError("a convolution of the neck has no bias")
        # Normalise the output per channel, keeping the bias
        own = bias.clone()
        conv.weight.mul_(scale[:, None, None, None])
        bias.copy_((own - mean) * scale + own)
        features = conv(features)


def _convolutions(module: nn.Module) -> Iterator[nn.Conv2d]:
    return (m for m in module.modules() if isinstance(m, nn.Conv2d))


def build(
    *, seed: int = 0, heads: HeadsName = "nuscenes", sampling: Sampling = "operator"
) -> VadTiny:
    """Build and initialise; the same seed gives the same bytes."""
    model = VadTiny(heads, sampling).requires_grad_(False).eval()
    initialise(model, rendered(VAD_TINY, seed, CALIBRATION_STRIDE), seed)
    return model
