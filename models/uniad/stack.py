"""The whole UniAD-tiny model."""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.bev.neck import FeaturePyramid
from models.bev.sizes import EMBED, Sampling
from models.bev.transformer import Motions
from models.regions import region
from models.resnet import ResNet
from models.uniad.config import PUBLISHED, UniadConfig
from models.uniad.map import MapHead
from models.uniad.motion import Agents, MotionHead
from models.uniad.occ import OccHead
from models.uniad.perception import Found, Queries, TrackHead
from models.uniad.planner import PlanningHead
from models.uniad.track_life import (
    SAVE_PERIOD,
    SLEEPS,
    LidarPose,
    MemoryBank,
    QueryInteraction,
    TrackLife,
    TrackSlots,
    VelocityUpdate,
)


class CameraTrunk(ResNet):
    """ResNet-50 up to the feature maps that the neck reads."""

    def __init__(self, stem: int, stages: tuple[int, ...]) -> None:
        super().__init__(stem, bottleneck=True)
        self.chosen = stages
        self.read = [self.channels[stage] for stage in stages]

    def forward(self, images: Tensor) -> list[Tensor]:
        """Map [N, 3, H, W] to [N, channels, h, w] each."""
        maps = self.stages(images)
        return [maps[stage] for stage in self.chosen]


class Seen(NamedTuple):
    """Tracks of this frame in their slots, followed by the ego vehicle."""

    agents: Agents
    boxes: Tensor  # [slots, 10], metres
    scores: Tensor  # [slots], 0 in empty slots
    labels: Tensor  # [slots] int64


class UniadTiny(nn.Module):
    """Maps cameras, ego motion and tracks to tracks, map, forecasts and a plan.

    Hu et al. 2023, written from the published description, with the published
    dimensions and the original's parameter names. Fixed shapes require some
    differences: camera attention reads every camera for every cell and masks; tracks
    are in slots, of which the empty ones are masked (see `TrackLife`); all agents keep
    their slot in motion and occupancy, where the original gathers the visible ones. The
    host chooses which earlier view is fed back, the threshold of occupancy, and
    optimises the plan against it.

    Args:
        config: sizes.
        sampling: see `sample`.
        trained: build the map head's attention for the weights of the published file.
    """

    def __init__(
        self,
        config: UniadConfig = PUBLISHED,
        sampling: Sampling = "operator",
        *,
        trained: bool = False,
    ) -> None:
        super().__init__()
        self.config = config
        # Image branch
        self.img_backbone = CameraTrunk(config.stem, config.stages)
        self.img_neck = FeaturePyramid(
            self.img_backbone.read, len(config.hws) - len(config.stages), config.hws
        )
        # Tracking
        self.query_embedding = nn.Embedding(config.queries, 2 * EMBED)
        self.reference_points = nn.Linear(EMBED, 3)
        self.velo_update = VelocityUpdate(config.grid.pc_range)
        self.track_base = TrackLife(config)
        self.query_interact = QueryInteraction()
        self.memory_bank = MemoryBank()
        # Heads
        self.pts_bbox_head = TrackHead(config, sampling)
        self.seg_head = MapHead(config, sampling, trained=trained)
        self.motion_head = MotionHead(config, sampling)
        self.occ_head = OccHead(config, sampling)
        self.planning_head = PlanningHead(config.head_hw, config.labels.commands)

    def forward(
        self,
        img: Tensor,
        lidar2img: Tensor,
        can_bus: Tensor,
        command: Tensor,
        l2g_r_mat: Tensor,
        l2g_t: Tensor,
        timestamp: Tensor,
        prev_bev: Tensor,
        prev_l2g_r_mat: Tensor,
        prev_l2g_t: Tensor,
        prev_timestamp: Tensor,
        *prev_tracks: Tensor,
    ) -> tuple[Tensor, ...]:
        """Process one frame; return the next recurrent inputs, then the other outputs.

        Args:
            img: [1, 6, 3, rows, columns] float32, normalised.
            lidar2img: [1, 6, 4, 4] float32.
            can_bus: [18] float32.
            command: [1] int64, of the navigator.
            l2g_r_mat: [1, 3, 3] float32, rows are the lidar's axes in the world.
            l2g_t: [1, 3] float32, metres: position of the lidar.
            timestamp: [1] float32, seconds since any start, so that they are small.
            prev_bev: [cells, 1, 256] float32; all recurrent inputs are zeros at the
                start.
            prev_l2g_r_mat: of the last frame, like the next two.
            prev_l2g_t: [1, 3].
            prev_timestamp: [1].
            prev_tracks: the fields of `TrackSlots`.
        """
        # Images to features
        before = LidarPose(prev_l2g_r_mat, prev_l2g_t, prev_timestamp)
        tracks = TrackSlots(*prev_tracks)
        now = LidarPose(l2g_r_mat, l2g_t, timestamp)
        with region("backbone"):
            stages = self.img_backbone(img.flatten(0, 1))
        with region("neck"):
            levels = self.img_neck(stages)
        with region("track"):
            queries = self._queries(tracks, before, now)
        # View and tracks
        motions = Motions(lidar2img, can_bus, prev_bev)
        found = self.pts_bbox_head(levels, motions, queries)
        with region("track"):
            seen, kept = self._track(found, queries.query, tracks)
        with region("bev_encoder"):
            bev, bev_pos = self.enlarged(found.bev), self.enlarged(found.bev_pos)
        # Map, motion, occupancy and plan
        with region("map"):
            lanes = self.seg_head(bev)
        with region("motion"):
            motion = self.motion_head(seen.agents, lanes.query + lanes.pos, bev)
        with region("occ"):
            occupancy = self.occ_head(bev, seen.agents, motion, seen.scores)
        with region("planner"):
            plan = self.planning_head(
                motion.modes[:, -1], seen.agents.query[:, -1], command, bev, bev_pos
            )
        with region("bev_encoder"):
            answer = found.bev.transpose(0, 1)
        with region("track"):
            pose = l2g_r_mat + 0, l2g_t + 0, timestamp + 0
        return (
            answer,
            *pose,
            *kept,
            found.scores,
            found.boxes,
            seen.boxes,
            seen.scores,
            seen.labels,
            lanes.query,
            lanes.scores,
            lanes.boxes,
            lanes.masks,
            motion.trajectories,
            motion.scores,
            occupancy,
            plan,
        )

    def enlarged(self, cells: Tensor) -> Tensor:
        """Upsample [1, cells, 256] for the heads after tracking."""
        if self.config.upsampled == 1:
            return cells
        image = cells.transpose(1, 2).unflatten(2, self.config.grid.hw)
        image = functional.interpolate(image, self.config.head_hw, mode="nearest")
        return image.flatten(2).transpose(1, 2)

    def _queries(
        self, tracks: TrackSlots, before: LidarPose, now: LidarPose
    ) -> Queries:
        """Return the new queries, the last of them the ego's, then the tracks'."""
        new = self.query_embedding.weight
        at = self.reference_points(new[:, :EMBED])
        carried = self.velo_update(tracks.ref_pts, tracks.velocity, before, now)
        # New queries are never empty
        empty = torch.cat([torch.zeros_like(at[:, 0]) > 0, tracks.obj_idxes == 0])
        return Queries(
            torch.cat([new, tracks.query])[None],
            torch.cat([at, carried])[None],
            empty[None],
        )

    def _track(
        self, found: Found, query: Tensor, before: TrackSlots
    ) -> tuple[Seen, TrackSlots]:
        """Update the tracks and make the queries of the next frame."""
        new = self.config.queries
        last, boxes = found.scores[-1, 0], found.boxes[-1, 0]
        scores, labels = last.sigmoid().amax(1), last.argmax(1)
        # Which queries are tracks now, and where their history is
        lives = self.track_base(scores, before)
        chosen, ids = lives.chosen, lives.obj_idxes
        seen = self._seen(found, chosen, ids, (boxes, scores, labels))
        old = (chosen >= new).to(torch.int64)
        place = (chosen - new) * old
        kept = old.to(scores.dtype)
        period = before.save_period[place] * old
        due = (period == 0) & (ids > 0)
        # Update the memory and the time to the next save
        track, bank, held = self.memory_bank(
            found.embeddings[chosen],
            before.mem_bank[place],
            before.mem_held[place] * kept[:, None],
            due,
        )
        less = (period - 1) * (period > 0).to(torch.int64)
        period = torch.where(due, period + SAVE_PERIOD, less)
        asked = self.query_interact(query[:, chosen], track[None], (ids == 0)[None])
        return seen, TrackSlots(
            asked[0],
            found.reference[chosen],
            ids,
            lives.disappear_time,
            period,
            boxes[chosen][:, -2:],
            bank,
            held,
            lives.max_obj_id,
        )

    def _seen(
        self,
        found: Found,
        chosen: Tensor,
        ids: Tensor,
        of_all: tuple[Tensor, Tensor, Tensor],
    ) -> Seen:
        """Return the input of the heads after tracking: slots, then the ego vehicle."""
        boxes, scores, labels = of_all
        behind = self.config.queries
        ego = behind - 1
        # Hide empty slots and weak tracks
        score = scores[chosen]
        empty = (ids == 0) | (score < SLEEPS)
        label = labels[chosen]
        nothing = torch.zeros_like(label[:1])
        agents = Agents(
            torch.cat([found.embeddings[chosen], found.embeddings[ego:behind]])[None],
            torch.cat([boxes[chosen], boxes[ego:behind]]),
            torch.cat([label, nothing]),
            torch.cat([empty, nothing > 0])[None],
        )
        there = (ids > 0).to(score.dtype)
        return Seen(agents, boxes[chosen], score * there, label)
