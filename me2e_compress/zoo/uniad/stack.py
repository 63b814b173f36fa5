"""The whole of UniAD-tiny: its modules and their parameters."""

import torch
from torch import nn

from me2e_compress.zoo.bev.decoder import Decoder
from me2e_compress.zoo.bev.encoder import BevEncoder, GridPosition
from me2e_compress.zoo.bev.neck import FeaturePyramid
from me2e_compress.zoo.bev.sizes import BOX_CODE, CAMERAS, EMBED, Sampling
from me2e_compress.zoo.resnet import BLOCKS, Bottleneck, ResNet
from me2e_compress.zoo.uniad.config import UniadConfig
from me2e_compress.zoo.uniad.layers import mlp, projection
from me2e_compress.zoo.uniad.map import MapHead
from me2e_compress.zoo.uniad.motion import MotionHead
from me2e_compress.zoo.uniad.occ import OccHead
from me2e_compress.zoo.uniad.planner import PlanningHead
from me2e_compress.zoo.uniad.tracking import MemoryBank, QueryInteraction

CAN_BUS = 18
PAST_STEPS = 8

PUBLISHED = UniadConfig()


class TrackTransformer(nn.Module):
    """BEV encoder and track decoder."""

    def __init__(self, config: UniadConfig, sampling: Sampling) -> None:
        super().__init__()
        levels = len(config.hws)
        self.level_embeds = nn.Parameter(torch.empty(levels, EMBED))
        self.cams_embeds = nn.Parameter(torch.empty(CAMERAS, EMBED))
        self.can_bus_mlp = nn.Sequential(
            nn.Linear(CAN_BUS, EMBED // 2),
            nn.ReLU(),
            nn.Linear(EMBED // 2, EMBED),
            nn.ReLU(),
        )
        self.can_bus_mlp.add_module("norm", nn.LayerNorm(EMBED))
        self.encoder = BevEncoder(
            config.grid, config.image_hw, config.hws, config.encoder_layers, sampling
        )
        self.decoder = Decoder(
            config.grid.hw, config.decoder_layers, sampling, height=True
        )


class TrackHead(nn.Module):
    """Queries and branches of tracking."""

    def __init__(self, config: UniadConfig, sampling: Sampling, *, dead: bool) -> None:
        super().__init__()
        layers = range(config.decoder_layers)
        self.code_weights = nn.Parameter(torch.empty(BOX_CODE))
        self.positional_encoding = GridPosition(config.grid.hw)
        self.transformer = TrackTransformer(config, sampling)
        self.bev_embedding = nn.Embedding(config.grid.cells, EMBED)
        self.cls_branches = nn.ModuleList(
            nn.Sequential(
                *projection(EMBED, EMBED),
                *projection(EMBED, EMBED),
                nn.Linear(EMBED, config.classes),
            )
            for _ in layers
        )
        self.reg_branches = nn.ModuleList(
            mlp(EMBED, EMBED, EMBED, BOX_CODE) for _ in layers
        )
        if dead:
            self.past_traj_reg_branches = nn.ModuleList(
                mlp(EMBED, EMBED, EMBED, PAST_STEPS * 2) for _ in layers
            )


class UniadTiny(nn.Module):
    """UniAD-tiny of Bench2DriveZoo (Hu et al. 2023).

    Args:
        config: Sizes.
        sampling: See `sample`.
        dead: Hold the weights that inference never reads, as the published file does.
    """

    def __init__(
        self,
        config: UniadConfig = PUBLISHED,
        sampling: Sampling = "operator",
        *,
        dead: bool = False,
    ) -> None:
        super().__init__()
        self.img_backbone = ResNet(Bottleneck, BLOCKS, config.stem)
        self.img_neck = FeaturePyramid(self.img_backbone.channels[1:], extra=1)
        self.query_embedding = nn.Embedding(config.queries, 2 * EMBED)
        self.reference_points = nn.Linear(EMBED, 3)
        self.query_interact = QueryInteraction()
        self.memory_bank = MemoryBank()
        self.pts_bbox_head = TrackHead(config, sampling, dead=dead)
        self.seg_head = MapHead(config, sampling, dead=dead)
        self.motion_head = MotionHead(config, sampling, dead=dead)
        self.occ_head = OccHead()
        self.planning_head = PlanningHead(config.head_hw)
