"""The whole VAD-tiny model."""

from torch import Tensor, nn

from models.bev.neck import FeaturePyramid
from models.bev.sizes import Sampling
from models.drawing import (
    Gains,
    draw_weights,
    normalise_neck,
    one_thread,
    take_statistics,
)
from models.regions import region
from models.resnet import ResNet50
from models.vad.config import HEADS, PUBLISHED, HeadsName, VadConfig
from models.vad.planner import Outputs, PlanningHead

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


class VadTiny(nn.Module):
    """Maps cameras, ego motion and the previous BEV to a plan (Jiang et al. 2023).

    Written from the published description, with the published dimensions and the
    original's parameter names except for the layers of `LaneNet`; a module map fits
    both (`published_names` has the difference). An export at fixed shapes requires two
    more differences: camera attention reads every camera for every cell and masks, and
    the map for the motion is masked instead of gathered.
    """

    def __init__(
        self,
        heads: HeadsName = "nuscenes",
        sampling: Sampling = "operator",
        config: VadConfig = PUBLISHED,
    ) -> None:
        super().__init__()
        self.img_backbone = ResNet50(config.stem)
        self.img_neck = FeaturePyramid(self.img_backbone.channels[-1:])
        self.pts_bbox_head = PlanningHead(HEADS[heads], sampling, config)

    def forward(
        self, img: Tensor, lidar2img: Tensor, can_bus: Tensor, prev_bev: Tensor
    ) -> Outputs:
        """Process one frame and return the outputs in the order of the stack.

        ``img`` is [1, 6, 3, 384, 640], normalised; ``prev_bev`` [10000, 1, 256] is zero
        at the start of a scene; all inputs are float32.
        """
        with region("backbone"):
            features = self.img_backbone(img.flatten(0, 1))
        with region("neck"):
            (features,) = self.img_neck([features])
        out: Outputs = self.pts_bbox_head(features, lidar2img, can_bus, prev_bev)
        return out


def initialise(model: VadTiny, images: Tensor, seed: int) -> None:
    """Draw parameters, then statistics of images [N, 3, H, W], normalised, in place."""
    draw_weights(model, GAINS, seed)
    with one_thread():
        # The backbone first, then the neck layer by layer
        features = take_statistics(model.img_backbone, images)
        normalise_neck(model.img_neck, [features])
