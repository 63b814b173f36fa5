"""The whole of TransFuser v6, LEAD's driving model."""

from torch import Tensor, nn

from models.drawing import Gains, draw_weights, one_thread, take_statistics
from models.lead.backbone import TransfuserBackbone
from models.lead.config import LeadConfig
from models.lead.heads import BevDecoder, CenterNetDecoder, PerspectiveDecoder
from models.lead.planner import PlanningDecoder

PUBLISHED = LeadConfig()

GAINS = Gains(
    by_name=(
        (r"(route|wp|target_speed)_decoder|attn|linear2|mlp\.2", 1.0),
        # Smooth kernels on enlarged, smooth maps: twice the gain that noise would have
        (r"deconv|_head\.|\.net\.|up_conv", 0.6),
    ),
    last_norm=r"layer\d\.\d\.bn2\.weight$",
    embeddings=r"pos_emb|\.query$",
)


class TransfuserV6(nn.Module):
    """Maps a strip of three cameras, a LiDAR raster and the ego state to a plan.

    Written from the published description of LEAD (autonomousvision/lead, 2025), with
    the dimensions and parameter names of its model on ResNet-34. Nothing is remembered
    between frames; the host follows the route at the target speed. Its radar, and the
    depth of pixels, which only training reads, are left out.
    """

    def __init__(self, config: LeadConfig = PUBLISHED) -> None:
        super().__init__()
        self.config = config
        self.backbone = TransfuserBackbone(config)
        channels = self.backbone.channels[-1]
        self.semantic_decoder = PerspectiveDecoder(channels, config)
        self.bev_semantic_decoder = BevDecoder(config)
        self.center_net_decoder = CenterNetDecoder(config)
        self.planning_decoder = PlanningDecoder(channels, config)

    def forward(
        self,
        rgb: Tensor,
        rasterized_lidar: Tensor,
        speed: Tensor,
        command: Tensor,
        *points: Tensor,
    ) -> tuple[Tensor, ...]:
        """Compute plan, pictures and boxes of one frame.

        Args:
            rgb: [1, 3, 384, 1152] float32, grey levels 0 to 255: left, front, right.
            rasterized_lidar: [1, 1, 320, 384] float32, 0 to 1: rows to the right from
                40 m left, columns ahead from 32 m behind, four a metre.
            speed: [1] float32, m/s.
            command: [1, 6] float32, one-hot.
            points: target point, the one before and the one after, each [1, 2] float32,
                metres ahead and to the right.

        Returns:
            Those of `PlanningDecoder`, `PerspectiveDecoder`, `BevDecoder` and
            `CenterNetDecoder`.
        """
        bev, image = self.backbone(rgb, rasterized_lidar)
        plan = self.planning_decoder(bev, speed, command, points)
        semantic = self.semantic_decoder(image)
        features = self.backbone.top_down(bev)
        boxes = self.center_net_decoder(features)
        return *plan, semantic, self.bev_semantic_decoder(features), *boxes


def initialise(model: TransfuserV6, images: Tensor, rasters: Tensor, seed: int) -> None:
    """Draw parameters, then statistics of [N, 3, H, W] and [N, 1, h, w], in place."""
    draw_weights(model, GAINS, seed)
    with one_thread():
        take_statistics(model.backbone, images, rasters)
