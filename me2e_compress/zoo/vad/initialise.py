"""Draw weights from a seed so that the untrained network reacts to its input.

A network drawn at random loses its input on the way: activations of different images
share a large common part, averages over hundreds of keys cancel, and the plan hardly
changes with a camera. So the statistics of backbone and neck are taken from rendered
frames, residual branches that carry information are stronger than their shortcuts, and
the weights of a linear layer sum to zero, which cancels the common part that a ReLU
leaves. No two tensors are equal and none is constant, as in a trained model: an
exporter merges equal ones.
"""

from torch import Tensor

from me2e_compress.zoo.drawing import (
    Gains,
    draw_weights,
    normalise_neck,
    one_thread,
    take_statistics,
)
from me2e_compress.zoo.vad.stack import VadTiny

GAINS = Gains(
    by_name=(
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
    ),
    last_norm=r"bn3\.weight$",
)
"""Found by trial: the tests state what they must achieve. Strong regressions would move
reference points by whole cells at the least noise, so theirs are small."""


def initialise(model: VadTiny, images: Tensor, seed: int) -> None:
    """Draw parameters, then statistics of images [N, 3, H, W], normalised, in place."""
    draw_weights(model, GAINS, seed)
    with one_thread():
        # The backbone first, then the neck layer by layer
        features = take_statistics(model.img_backbone, images)
        normalise_neck(model.img_neck, [features])
