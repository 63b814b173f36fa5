"""The planning head of UniAD: the path of the ego vehicle."""

import torch
from torch import Tensor, nn

from models.bev.layers import TransformerLayer, mlp, projection
from models.bev.sizes import EMBED
from models.uniad.config import PLAN_STEPS

ADAPTERS, LAYERS = 3, 3
ADAPTER_WIDTH = 128


class PlannerDecoder(nn.Module):
    """Three `TransformerLayer`s."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList(TransformerLayer() for _ in range(LAYERS))

    def forward(self, query: Tensor, memory: Tensor) -> Tensor:
        """Map [1, 1, 256], reading [1, cells, 256], to [1, 1, 256]."""
        for layer in self.layers:
            query = layer(query, memory)
        return query


class PlanningHead(nn.Module):
    """Plans with one query, made of the ego's track, its motion and the command."""

    def __init__(self, hw: tuple[int, int], commands: int) -> None:
        super().__init__()
        self.hw = hw
        self.navi_embed = nn.Embedding(commands, EMBED)
        self.reg_branch = mlp(EMBED, EMBED, PLAN_STEPS * 2)
        self.attn_module = PlannerDecoder()
        self.mlp_fuser = projection(3 * EMBED, EMBED)
        self.pos_embed = nn.Embedding(1, EMBED)
        self.bev_adapter = nn.Sequential(
            *(
                nn.Sequential(
                    nn.Conv2d(EMBED, ADAPTER_WIDTH, 3, padding=1),
                    nn.ReLU(),
                    nn.Conv2d(ADAPTER_WIDTH, EMBED, 1),
                )
                for _ in range(ADAPTERS)
            )
        )

    def forward(
        self,
        modes: Tensor,
        track: Tensor,
        command: Tensor,
        bev: Tensor,
        bev_pos: Tensor,
    ) -> Tensor:
        """Plan [1, 6, 2], metres in the lidar frame, every 0.5 s.

        ``modes`` [1, 6, 256] are the ego's queries of the last motion layer, ``track``
        [1, 256] its track query, ``command`` [1] int64, ``bev`` [1, cells, 256] the
        upsampled view.
        """
        # Fuse command, track and modes into one query
        told = self.navi_embed(command).unsqueeze(1).expand_as(modes)
        known = track.unsqueeze(1).expand_as(modes)
        fused = self.mlp_fuser(torch.cat([modes, known, told], -1))
        query = fused.amax(1, keepdim=True) + self.pos_embed.weight
        # Adapt the view, then decode
        memory = bev + bev_pos
        image = memory.transpose(1, 2).unflatten(2, self.hw)
        memory = (image + self.bev_adapter(image)).flatten(2).transpose(1, 2)
        steps = self.reg_branch(self.attn_module(query, memory))
        out: Tensor = steps.view(1, PLAN_STEPS, 2).cumsum(1)
        return out
