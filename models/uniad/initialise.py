"""Draw weights of UniAD, calibrated on images of six cameras."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.bev.sizes import BOX_CODE, EMBED
from models.bev.transformer import CAN_BUS, Motions
from models.drawing import (
    Gains,
    draw_weights,
    normalise_neck,
    one_thread,
    take_statistics,
)
from models.uniad.config import AGENT_MODES
from models.uniad.motion import Agents, Forecasts
from models.uniad.stack import UniadTiny
from models.uniad.track_life import BEGINS

GAINS = Gains(
    by_name=(
        (r"attn_module.*multihead_attn\.out_proj", 4.0),
        (r"occ_head.*attentions\.0.*in_proj_weight", 0.4),
        (r"occ_head\.dense_decoder\.layers\.\d\.up", 0.3),
        (r"out_proj", 1.5),
        (r"in_proj_weight", 1.2),
        (r"decoder\..*attentions\.1\.output_proj", 1.0),
        (r"attentions\.0\.output_proj", 1.0),
        (r"decoder\..*value_proj", 0.7),
        (r"value_proj", 2.0),
        (r"attentions\.1\.output_proj", 2.5),
        (r"sampling_offsets", 0.6),
        (r"attention_weights|reference_points", 1.2),
        (r"pts_bbox_head\.reg_branches\.\d\.4", 0.05),
        (r"seg_head\.reg_branches\.\d\.4", 0.015),
        (r"traj_reg_branches\.\d\.4", 0.1),
        (r"ffns\.0\.layers\.1", 0.7),
        (r"planning_head\.reg_branch\.2", 1.0),
        (r"bev_adapter", 0.7),
        (r"temporal_mlp_for_mask\.layers\.2", 0.03),
        (r"query_to_occ_feat\.layers\.2", 0.08),
    ),
    last_norm=r"bn3\.weight$",
)
"""Found by trial: the tests state what they must achieve. Strong regressions would move
reference points by whole cells at the least noise, so their gains are small, as are
those of logits with strong inputs: a sharp softmax or sigmoid amplifies rounding
errors."""

BEGINNING = 0.03
"""Fraction of the queries that find something in a first frame."""

OWN_MOTION = 0.2
"""Scale of the ego motion's influence on the view, which should depend on images."""

CENTRE = [0, 1, 4]
"""Columns of a box with x, y and z."""

STEADY = 0.1
"""Remaining fraction of the move of a centre."""

AGENTS = 8


def initialise(
    model: UniadTiny,
    images: Tensor,
    lidar2img: Tensor,
    seed: int,
    beginning: float = BEGINNING,
) -> None:
    """Draw all parameters, then take statistics, in place.

    Args:
        model: of any size.
        images: [6, 3, H, W], normalised. Use full-size ones: the common part of
            features differs by scale, and with it the number of tracks.
        lidar2img: [1, 6, 4, 4].
        seed: of everything.
        beginning: fraction of the queries that find something in these images.
    """
    draw_weights(model, GAINS, seed)
    # Weaken ego motion, steady the centres, open the masks
    norm = model.pts_bbox_head.transformer.can_bus_mlp.get_submodule("norm")
    for parameter in norm.parameters():
        parameter.mul_(OWN_MOTION)
    _hold_centres(model)
    _open_masks(model)
    # Normalise the features, then balance classes and occupancy
    with one_thread():
        take_statistics(model.img_backbone, images)
        levels = normalise_neck(model.img_neck, model.img_backbone(images))
        view = _view(model, levels, lidar2img)
        _balance_classes(model, view, beginning)
        noise = torch.Generator().manual_seed(seed)
        take_statistics(_Occupancy(model, noise), model.enlarged(view))


def _hold_centres(model: UniadTiny) -> None:
    """Make the layers move the centre of a box only a little.

    If centres move by whole cells, rounding errors grow between layers and frames.
    """
    for branch in model.pts_bbox_head.reg_branches:
        for parameter in branch.get_submodule("4").parameters():
            parameter[CENTRE] *= STEADY


def _open_masks(model: UniadTiny) -> None:
    """Make features of cells positive on average.

    Of millions of random logits some are at the threshold, where rounding decides.
    """
    last = model.occ_head.temporal_mlp_for_mask.layers[-1]
    last.get_parameter("bias").abs_()


def _view(model: UniadTiny, levels: list[Tensor], lidar2img: Tensor) -> Tensor:
    """Return the first bird's eye view, [1, cells, 256], of levels of any size."""
    config, head = model.config, model.pts_bbox_head
    right = [
        functional.interpolate(level, list(hw), mode="nearest")
        for level, hw in zip(levels, config.hws, strict=True)
    ]
    still = torch.zeros(CAN_BUS), torch.zeros(config.grid.cells, 1, EMBED)
    cells = head.bev_embedding.weight[None], head.positional_encoding()
    tokens = torch.cat(head.transformer.tokens(right), 1)
    return head.transformer.bev(tokens, cells, Motions(lidar2img, *still))


def _balance_classes(model: UniadTiny, cells: Tensor, beginning: float) -> None:
    head, query = model.pts_bbox_head, model.query_embedding.weight[None]
    pos, content = query.chunk(2, 2)
    at = model.reference_points(pos).sigmoid()
    decoder = head.transformer.decoder
    states, _, _ = decoder(content, pos, cells, at, head.reg_branches)
    # Same mean for all classes, then the wanted quantile
    for branch, state in zip(head.cls_branches, states, strict=True):
        bias = branch.get_submodule("6").get_parameter("bias")
        bias.add_(bias - branch(state).mean((0, 1)))
        best = branch(state).amax(2)
        bias.add_(BEGINS.logit() - best.quantile(1 - beginning))


class _Occupancy(nn.Module):
    def __init__(self, model: UniadTiny, noise: torch.Generator) -> None:
        super().__init__()
        self.head = model.occ_head
        count = (1, AGENTS + 1)
        query = torch.randn(*count, EMBED, generator=noise)
        modes = torch.randn(*count, AGENT_MODES, EMBED, generator=noise)
        nothing = torch.zeros(1)
        self.agents = Agents(
            query,
            torch.zeros(AGENTS + 1, BOX_CODE),
            torch.zeros(AGENTS + 1, dtype=torch.int64),
            torch.zeros(*count, dtype=torch.bool),
        )
        self.motion = Forecasts(nothing, nothing, modes, query)

    def forward(self, bev: Tensor) -> Tensor:
        out: Tensor = self.head(bev, self.agents, self.motion, torch.ones(AGENTS))
        return out
