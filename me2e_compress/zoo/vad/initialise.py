"""Weights from a seed, shaped so that the untrained network reacts to its input.

A network drawn at random forgets its input on the way: activations of different images
share a large common part, averages over hundreds of keys cancel, and the plan hardly
moves when a camera changes. So statistics of the backbone and of the neck are taken
from rendered frames, residual branches that carry information are stronger than what
they are added to, and the weights of a linear layer sum to zero, which cancels the
common part that a ReLU leaves. No two tensors are equal and none is constant, as in a
trained model: an exporter merges equal ones.
"""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn import functional

from me2e_compress.errors import GraphError
from me2e_compress.zoo.stacks import VAD_TINY
from me2e_compress.zoo.synthetic_frames import frames
from me2e_compress.zoo.vad.config import ATTENTION_HEADS, HEADS, HeadsName, Sampling
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
"""Standard deviation of an output for a unit input, by a pattern in the name: the first
that matches; 1.4 (ReLU, He et al. 2015) where none does. Found by trial: the tests
state what they must achieve. Strong regressions would move reference points by whole
cells at the least noise, so theirs are small."""

DEFAULT_GAIN = math.sqrt(2)
EMBEDDING_STD = 0.3
BIAS_STD = 0.1
RESIDUAL_SCALE = 0.35
"""Of the last normalisation of a residual block, so that 16 blocks do not explode."""

CALIBRATION_FRAMES = 4
CALIBRATION_STRIDE = 2
"""Every second pixel is enough for the statistics of a channel."""


def initialise(model: VadTiny, seed: int) -> None:
    """Draw all parameters, then the statistics of the image branch, in place."""
    generator = torch.Generator().manual_seed(seed)
    modules = dict(model.named_modules())
    for name, parameter in model.named_parameters():
        owner = modules[name.rpartition(".")[0]]
        parameter.copy_(_draw(name, parameter, owner, generator))
    with _one_thread():
        _calibrate(model, seed)


def _draw(
    name: str, parameter: Tensor, owner: nn.Module, generator: torch.Generator
) -> Tensor:
    noise = torch.empty_like(parameter).normal_(generator=generator)
    if isinstance(owner, nn.BatchNorm2d | nn.LayerNorm) or "code_weights" in name:
        noise = noise.clamp(-3, 3) * BIAS_STD
        if name.endswith("bias"):
            return noise
        return (1 + noise) * (RESIDUAL_SCALE if name.endswith("bn3.weight") else 1.0)
    if isinstance(owner, nn.Embedding) or "_embeds" in name:
        return noise * EMBEDDING_STD
    if name.endswith("sampling_offsets.bias"):
        return _spread(parameter) + noise * BIAS_STD
    if parameter.dim() == 1:
        return noise * BIAS_STD
    if parameter.dim() == 4:
        noise = _smooth(noise)
    elif isinstance(owner, nn.Linear):
        noise = noise - noise.mean(1, keepdim=True)
    gain = next((gain for part, gain in GAINS if re.search(part, name)), DEFAULT_GAIN)
    return noise * (gain / math.sqrt(parameter[0].numel()))


def _smooth(kernels: Tensor) -> Tensor:
    """Blur the kernels, at the same standard deviation: [out, in, k, k].

    White-noise kernels respond to pixel noise more than to shapes; trained ones are
    smooth.
    """
    blurred = kernels
    for _ in range(kernels.shape[-1] // 3):
        blurred = functional.avg_pool2d(blurred, 3, 1, 1, count_include_pad=False)
    return blurred * (kernels.std() / blurred.std())


def _spread(bias: Tensor) -> Tensor:
    """Return deformable DETR's offsets: a direction a head, a step more a point."""
    angles = torch.arange(ATTENTION_HEADS) * (2 * math.pi / ATTENTION_HEADS)
    directions = torch.stack([angles.cos(), angles.sin()], -1)
    directions = directions / directions.abs().amax(-1, keepdim=True)
    points = bias.numel() // (ATTENTION_HEADS * 2)
    steps = torch.arange(points) % 8 + 1
    return (directions[:, None] * steps[:, None]).flatten()


def _calibrate(model: VadTiny, seed: int) -> None:
    """Take normalisation statistics from rendered frames."""
    step = CALIBRATION_STRIDE
    images = torch.cat(
        [
            torch.from_numpy(frame["img"])[0, :, :, ::step, ::step]
            for frame in frames(VAD_TINY, CALIBRATION_FRAMES, seed, scene_length=1)
        ]
    )
    norms = [m for m in model.img_backbone.modules() if isinstance(m, nn.BatchNorm2d)]
    for norm in norms:
        norm.train()
        norm.momentum = 1.0
    features = model.img_backbone(images)
    for norm in norms:
        norm.eval()
        norm.momentum = 0.1
    for conv in _convolutions(model.img_neck):
        out = conv(features)
        mean = out.mean((0, 2, 3))
        scale = out.std((0, 2, 3)).reciprocal()
        bias = conv.bias
        if bias is None:
            raise TypeError("a convolution of the neck has no bias")
        own = bias.clone()
        conv.weight.mul_(scale[:, None, None, None])
        bias.copy_((own - mean) * scale + own)
        features = conv(features)


def _convolutions(module: nn.Module) -> Iterator[nn.Conv2d]:
    return (m for m in module.modules() if isinstance(m, nn.Conv2d))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Run on one thread, so that sums do not depend on the machine's load."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            yield
    finally:
        torch.set_num_threads(threads)


def build(
    *, seed: int = 0, heads: HeadsName = "nuscenes", sampling: Sampling = "operator"
) -> VadTiny:
    """Build and initialise; the same seed gives the same bytes.

    Raises:
        GraphError: There are no heads of that name.
    """
    if heads not in HEADS:
        raise GraphError(f"no heads {heads!r}: there is {', '.join(HEADS)}")
    model = VadTiny(heads, sampling).requires_grad_(False).eval()
    initialise(model, seed)
    return model
