"""Begin, hide and end tracks in a fixed number of slots.

The original keeps a list of tracks on the host that grows and shrinks between frames.
Here a list has a fixed number of slots; empty ones, without an id, are masked. All of
it is one graph, and no shape depends on the data.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from me2e_compress.zoo.bev.decoder import inverse_sigmoid, precise_sigmoid
from me2e_compress.zoo.uniad.config import UniadConfig

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
