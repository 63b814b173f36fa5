"""The whole VAD-tiny model."""

from torch import Tensor, nn

from me2e_compress.zoo.bev.neck import FeaturePyramid
from me2e_compress.zoo.bev.sizes import Sampling
from me2e_compress.zoo.regions import region
from me2e_compress.zoo.resnet import ResNet50
from me2e_compress.zoo.vad.config import HEADS, PUBLISHED, HeadsName, VadConfig
from me2e_compress.zoo.vad.planner import Outputs, PlanningHead


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
