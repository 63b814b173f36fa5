"""Draw weights from a seed so that the untrained network reacts to its input.

A network drawn at random loses its input on the way: activations of different images
share a large common part, averages over hundreds of keys cancel, and the plan hardly
changes with a camera. So the statistics of backbone and neck are taken from rendered
frames, residual branches that carry information are stronger than their shortcuts, and
the weights of a linear layer sum to zero, which cancels the common part that a ReLU
leaves. No two tensors are equal and none is constant, as in a trained model: an
exporter merges equal ones.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.bev.neck import FeaturePyramid
from models.stacks import Stack
from models.synthetic_frames import frames

BIAS_STD = 0.1
EMBEDDING_STD = 0.3
DEFAULT_GAIN = math.sqrt(2)
RESIDUAL_SCALE = 0.35
"""Scale of the last normalisation of a residual block, so 16 blocks stay stable."""

ATTENTION_HEADS = 8

CALIBRATION_FRAMES = 4
CALIBRATION_STRIDE = 2
"""Every second pixel is enough for the statistics of a channel."""


@dataclass(frozen=True)
class Gains:
    """The standard deviation of drawn weights.

    Attributes:
        by_name: standard deviation of an output for a unit input, by a pattern of the
            name: the first match counts; 1.4 (ReLU, He et al. 2015) if none matches.
        last_norm: pattern of the normalisations that end a residual block.
        embeddings: pattern of the parameters that are drawn as embeddings are.
    """

    by_name: Sequence[tuple[str, float]]
    last_norm: str
    embeddings: str = "_embeds"

    def of(self, name: str) -> float:
        """Return the gain of a parameter."""
        matches = (gain for part, gain in self.by_name if re.search(part, name))
        return next(matches, DEFAULT_GAIN)


def draw_weights(model: nn.Module, gains: Gains, seed: int) -> None:
    """Draw all parameters of a model, in place."""
    generator = torch.Generator().manual_seed(seed)
    modules: Mapping[str, nn.Module] = dict(model.named_modules())
    # The order of parameters fixes the random numbers
    for name, parameter in model.named_parameters():
        owner = modules[name.rpartition(".")[0]]
        parameter.copy_(_drawn(name, parameter, owner, gains, generator))


def _drawn(
    name: str,
    parameter: Tensor,
    owner: nn.Module,
    gains: Gains,
    generator: torch.Generator,
) -> Tensor:
    noise = torch.empty_like(parameter).normal_(generator=generator)
    # Normalisations are near 1 and 0
    if isinstance(owner, nn.BatchNorm2d | nn.LayerNorm) or "code_weights" in name:
        noise = noise.clamp(-3, 3) * BIAS_STD
        if name.endswith("bias"):
            return noise
        return (1 + noise) * (RESIDUAL_SCALE if re.search(gains.last_norm, name) else 1)
    if isinstance(owner, nn.Embedding) or re.search(gains.embeddings, name):
        return noise * EMBEDDING_STD
    if name.endswith("sampling_offsets.bias"):
        return _spread(parameter) + noise * BIAS_STD
    if parameter.dim() == 1:
        return noise * BIAS_STD
    # Convolutions are smooth; linear layers sum to zero
    if parameter.dim() == 4:
        noise = _smooth(noise)
    elif isinstance(owner, nn.Linear):
        noise = noise - noise.mean(1, keepdim=True)
    return noise * (gains.of(name) / math.sqrt(parameter[0].numel()))


def _smooth(kernels: Tensor) -> Tensor:
    """Blur kernels [out, in, k, k] at the same deviation: trained ones are smooth."""
    blurred = kernels
    for _ in range(kernels.shape[-1] // 3):
        blurred = functional.avg_pool2d(blurred, 3, 1, 1, count_include_pad=False)
    return blurred * (kernels.std() / blurred.std())


def _spread(bias: Tensor) -> Tensor:
    """Return deformable DETR's offsets: a direction per head, a step per point."""
    angles = torch.arange(ATTENTION_HEADS) * (2 * math.pi / ATTENTION_HEADS)
    directions = torch.stack([angles.cos(), angles.sin()], -1)
    directions = directions / directions.abs().amax(-1, keepdim=True)
    points = bias.numel() // (ATTENTION_HEADS * 2)
    steps = torch.arange(points) % 8 + 1
    return (directions[:, None] * steps[:, None]).flatten()


def take_statistics(backbone: nn.Module, *inputs: Tensor) -> Any:
    """Set batch normalisations to statistics of inputs; return what it answers."""
    norms = [each for each in backbone.modules() if isinstance(each, nn.BatchNorm2d)]
    for norm in norms:
        norm.train()
        norm.momentum = 1.0
    features = backbone(*inputs)
    for norm in norms:
        norm.eval()
        norm.momentum = 0.1
    return features


def normalise_neck(neck: FeaturePyramid, stages: Sequence[Tensor]) -> list[Tensor]:
    """Scale the convolutions of a neck to outputs of unit size; return its levels."""
    maps = [
        _normalised(conv, stage)
        for conv, stage in zip(neck.lateral_convs, stages, strict=True)
    ]
    levels = [
        _normalised(conv, x) for conv, x in zip(neck.fpn_convs, maps, strict=False)
    ]
    for conv in neck.fpn_convs[len(maps) :]:
        levels.append(_normalised(conv, levels[-1]))
    return levels


def _normalised(module: nn.Module, x: Tensor) -> Tensor:
    """Normalise a convolution's output per channel, keeping its bias; return it."""
    convolution = module.get_submodule("conv")
    weight, bias = (convolution.get_parameter(name) for name in ("weight", "bias"))
    out = convolution(x)
    scale = out.std((0, 2, 3)).reciprocal()
    kept = bias.clone()
    weight.mul_(scale[:, None, None, None])
    bias.copy_((kept - out.mean((0, 2, 3))) * scale + kept)
    y: Tensor = convolution(x)
    return y


def rendered(spec: Stack, seed: int, stride: int = CALIBRATION_STRIDE) -> Tensor:
    """Return images of several scenes, [N, 3, H, W], with every ``stride``-th pixel."""
    (images,) = rendered_inputs(spec, (spec.image_input,), seed, stride)
    return images


def rendered_inputs(
    spec: Stack, names: Sequence[str], seed: int, stride: int = CALIBRATION_STRIDE
) -> list[Tensor]:
    """Return inputs that are maps of several scenes; see `rendered`."""
    made = list(frames(spec, CALIBRATION_FRAMES, seed, scene_length=1))
    maps = (
        [torch.from_numpy(frame[name])[..., ::stride, ::stride] for frame in made]
        for name in names
    )
    return [torch.cat([x.reshape(-1, *x.shape[-3:]) for x in each]) for each in maps]


@contextmanager
def one_thread() -> Iterator[None]:
    """Run on one thread, so that sums do not depend on the machine's load."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            yield
    finally:
        torch.set_num_threads(threads)
