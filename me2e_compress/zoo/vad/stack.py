"""The whole of VAD-tiny."""

from torch import Tensor, nn

from me2e_compress.zoo.bev.neck import FeaturePyramid
from me2e_compress.zoo.bev.sizes import Sampling
from me2e_compress.zoo.regions import region
from me2e_compress.zoo.resnet import ResNet50
from me2e_compress.zoo.vad.config import HEADS, PUBLISHED, HeadsName, VadConfig
from me2e_compress.zoo.vad.planner import Outputs, PlanningHead


class VadTiny(nn.Module):
    """Cameras, ego motion and the previous BEV to a plan (Jiang et al. 2023).

    Written from the published description, at the published dimensions and with the
    parameter names of the original but for the layers of `LaneNet`, so that a module
    map fits both (`published_names` has the difference). What else differs is
    what an export at fixed shapes asks for: camera attention reads every camera for
    every cell and masks, and the map for the motion is masked instead of gathered.
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
        """Drive one frame.

        Args:
            img: [1, 6, 3, 384, 640] float32, normalised.
            lidar2img: [1, 6, 4, 4] float32.
            can_bus: [18] float32.
            prev_bev: [10000, 1, 256] float32; all zeros at the start of a scene.

        Returns:
            bev_embed, all_cls_scores, all_bbox_preds, all_traj_preds,
            all_traj_cls_scores, map_all_cls_scores, map_all_bbox_preds,
            map_all_pts_preds, ego_fut_preds.
        """
        with region("backbone"):
            features = self.img_backbone(img.flatten(0, 1))
        with region("neck"):
            (features,) = self.img_neck([features])
        out: Outputs = self.pts_bbox_head(features, lidar2img, can_bus, prev_bev)
        return out
