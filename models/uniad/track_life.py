"""Begin, hide and end tracks in a fixed number of slots, and what each remembers.

The original keeps a list of tracks on the host that grows and shrinks between frames.
Here a list has a fixed number of slots; empty ones, without an id, are masked. All of
it is one graph, and no shape depends on the data.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.bev.attention import PackedAttention
from models.bev.decoder import inverse_sigmoid, precise_sigmoid
from models.bev.sizes import EMBED
from models.uniad.config import UniadConfig

BEGINS = torch.tensor(0.4)
"""Least score of a new track."""

SLEEPS = torch.tensor(0.35)
"""Score below which a track is hidden."""

PATIENCE = 5
"""Frames out of sight after which a track ends. All three: UniAD's tracker. Tensors:
the exporter would write a Python number as float64."""

SAVE_PERIOD = 3
"""Frames between two embeddings in the memory."""


class TrackSlots(NamedTuple):
    """Slots for tracks, from frame to frame; all zeros are empty."""

    query: Tensor  # [slots, 512], position then content
    ref_pts: Tensor  # [slots, 3], logits of x y z as parts of the range
    obj_idxes: Tensor  # [slots] int64, from 1; 0 is an empty slot
    disappear_time: Tensor  # [slots] int64, frames out of sight
    save_period: Tensor  # [slots] int64, frames until its embedding is kept
    velocity: Tensor  # [slots, 2], metres a second
    mem_bank: Tensor  # [slots, 4, 256], the newest last
    mem_held: Tensor  # [slots, 4], 1 where the bank holds something
    max_obj_id: Tensor  # [1] int64, the newest id


class Lives(NamedTuple):
    """Which queries of a frame are tracks."""

    chosen: Tensor  # [slots] int64: the query that each slot takes
    obj_idxes: Tensor  # [slots] int64, 0 for none
    disappear_time: Tensor  # [slots] int64
    max_obj_id: Tensor  # [1] int64


class LidarPose(NamedTuple):
    """The pose of the lidar, and its time."""

    rotation: Tensor  # [1, 3, 3]: rows are the axes of the lidar frame in the world
    position: Tensor  # [1, 3], metres
    seconds: Tensor  # [1]


class TrackLife(nn.Module):
    """Decides which of the frame's queries are tracks, and assigns their slots.

    Queries are the new ones first, then slots. Tracks keep their order and come before
    new ones, which take the free slots in order; those without a slot are dropped.
    """

    def __init__(self, config: UniadConfig) -> None:
        super().__init__()
        new, slots = config.queries, config.tracks
        self.slots = slots
        # Rank old slots before new queries
        order = torch.cat([torch.arange(new) + slots, torch.arange(slots)])
        self.register_buffer("rank", (new + slots - order).float(), False)
        self.register_buffer("places", torch.tensor([float(new + slots)]), False)
        self.register_buffer("none", torch.zeros(new, dtype=torch.int64), False)
        may_begin = torch.arange(new + slots) < new - 1  # not the ego vehicle's
        self.register_buffer("may_begin", may_begin, False)

    rank: Tensor
    places: Tensor
    none: Tensor
    may_begin: Tensor

    def forward(self, scores: Tensor, before: TrackSlots) -> Lives:
        """Map scores [queries] and the slots of the last frame to those of this one."""
        ids = torch.cat([self.none, before.obj_idxes])
        missed = torch.cat([self.none, before.disappear_time])
        # New tracks get the next ids
        seen = scores >= BEGINS
        begins = (seen & self.may_begin).to(torch.int64)
        # TensorRT adds up in float alone; numbers of queries are exact there
        nth = begins.to(self.rank.dtype).cumsum(0).to(torch.int64)
        ids = ids + begins * (before.max_obj_id + nth)
        # Tracks out of sight for too long end
        unseen = (ids > 0) & (scores < SLEEPS)
        missed = missed * torch.logical_not(seen).to(torch.int64)
        missed = missed + unseen.to(torch.int64)
        ids = ids * (missed < PATIENCE).to(torch.int64)
        missed = missed * (ids > 0).to(torch.int64)
        # Fill the slots: old tracks first
        urgency = self.rank + self.places * (ids > 0).to(self.rank.dtype)
        chosen = torch.topk(urgency, self.slots).indices
        newest = before.max_obj_id + begins.sum(0, keepdim=True)
        return Lives(chosen, ids[chosen], missed[chosen], newest)


class VelocityUpdate(nn.Module):
    """Moves reference points to the current frame by velocity and ego motion."""

    def __init__(self, pc_range: tuple[float, ...]) -> None:
        super().__init__()
        low, high = torch.tensor(pc_range[:3]), torch.tensor(pc_range[3:])
        self.register_buffer("low", low, False)
        self.register_buffer("extent", high - low, False)

    low: Tensor
    extent: Tensor

    def forward(
        self, ref_pts: Tensor, velocity: Tensor, before: LidarPose, now: LidarPose
    ) -> Tensor:
        """Map logits [slots, 3] and metres per second [slots, 2] to logits."""
        # Metres in the old lidar frame
        points = precise_sigmoid(ref_pts) * self.extent + self.low
        seconds = now.seconds - before.seconds
        moved = torch.cat([velocity, torch.zeros_like(velocity[:, :1])], 1) * seconds
        # Through the world into the new lidar frame
        world = torch.matmul(points + moved, before.rotation[0]) + before.position
        points = torch.matmul(world - now.position, now.rotation[0].transpose(0, 1))
        return inverse_sigmoid((points - self.low) / self.extent)


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
