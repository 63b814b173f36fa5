"""UniAD's state of a track between frames: its memory and its next query."""

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.attention import PackedAttention
from me2e_compress.zoo.bev.sizes import EMBED


class MemoryBank(nn.Module):
    """A track attends to its own past, and the memory is updated when due."""

    def __init__(self) -> None:
        super().__init__()
        self.save_proj = nn.Linear(EMBED, EMBED)
        self.temporal_attn = PackedAttention()
        self.temporal_fc1 = nn.Linear(EMBED, EMBED)
        self.temporal_fc2 = nn.Linear(EMBED, EMBED)
        self.temporal_norm1 = nn.LayerNorm(EMBED)
        self.temporal_norm2 = nn.LayerNorm(EMBED)

    def forward(
        self, track: Tensor, bank: Tensor, held: Tensor, due: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return tracks [tracks, 256], and ``bank`` and ``held`` of the next frame.

        ``bank`` [tracks, 4, 256] has the newest entry last; ``held`` [tracks, 4] is 1
        where an entry is set. A track whose newest entry is empty stays unchanged.
        Where ``due`` [tracks] is true a new entry replaces the oldest.
        """
        # Recall: mix the track with its past
        empty = held < 1
        recalled = self.temporal_attn(track[:, None], bank, bank, empty)[:, 0]
        mixed = self.temporal_norm1(track + recalled)
        changed = self.temporal_fc2(self.temporal_fc1(mixed).relu())
        mixed = self.temporal_norm2(mixed + changed)
        track = torch.where(empty[:, -1:], track, mixed)
        # Remember: shift the bank where it is due
        newer = torch.cat([bank[:, 1:], self.save_proj(track)[:, None]], 1)
        fuller = torch.cat([held[:, 1:], torch.ones_like(held[:, :1])], 1)
        bank = torch.where(due[:, None, None], newer, bank)
        return track, bank, torch.where(due[:, None], fuller, held)


class QueryInteraction(nn.Module):
    """Tracks attend to each other and become the next frame's queries."""

    def __init__(self) -> None:
        super().__init__()
        self.self_attn = PackedAttention()
        self.linear1 = nn.Linear(EMBED, EMBED)
        self.linear2 = nn.Linear(EMBED, EMBED)
        self.linear_pos1 = nn.Linear(EMBED, EMBED)
        self.linear_pos2 = nn.Linear(EMBED, EMBED)
        self.norm_pos = nn.LayerNorm(EMBED)
        self.linear_feat1 = nn.Linear(EMBED, EMBED)
        self.linear_feat2 = nn.Linear(EMBED, EMBED)
        self.norm_feat = nn.LayerNorm(EMBED)
        self.norm1 = nn.LayerNorm(EMBED)
        self.norm2 = nn.LayerNorm(EMBED)

    def forward(self, query: Tensor, track: Tensor, ignore: Tensor) -> Tensor:
        """Update queries [1, tracks, 512], position then content.

        Tracks are [1, tracks, 256]; ``ignore`` [1, tracks] bool is true in empty slots.
        """
        pos, content = query.chunk(2, 2)
        asked = pos + track
        x = self.norm1(track + self.self_attn(asked, asked, track, ignore))
        x = self.norm2(x + self.linear2(self.linear1(x).relu()))
        pos = self.norm_pos(pos + self.linear_pos2(self.linear_pos1(x).relu()))
        changed = self.linear_feat2(self.linear_feat1(x).relu())
        return torch.cat([pos, self.norm_feat(content + changed)], 2)
