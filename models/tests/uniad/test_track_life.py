"""Tracks in slots: when they begin, sleep and end, and where they are carried."""

import math

import torch

from models.uniad.config import RANGE, UniadConfig
from models.uniad.track_life import (
    LidarPose,
    Lives,
    TrackLife,
    TrackSlots,
    VelocityUpdate,
)

CONFIG = UniadConfig(queries=4, tracks=3)
"""Three queries and the ego's, three slots."""


def tracks(
    ids: list[int], missed: list[int] | None = None, newest: int = 9
) -> TrackSlots:
    nothing = torch.zeros(3)
    return TrackSlots(
        nothing,
        nothing,
        torch.tensor(ids),
        torch.tensor(missed or [0, 0, 0]),
        nothing,
        nothing,
        nothing,
        nothing,
        torch.tensor([newest]),
    )


def live(new: list[float], old: list[float], before: TrackSlots) -> Lives:
    lives: Lives = TrackLife(CONFIG)(torch.tensor([*new, *old]), before)
    return lives


def test_new_ones_get_ids_in_their_order_and_take_what_is_free() -> None:
    lives = live([0.5, 0.3, 0.4, 0.0], [0.0, 0.6, 0.0], tracks([0, 7, 0]))
    assert lives.obj_idxes.tolist() == [7, 10, 11]
    assert lives.chosen.tolist() == [5, 0, 2]
    assert lives.max_obj_id.tolist() == [11]


def test_the_ego_vehicle_and_an_empty_slot_never_begin_a_track() -> None:
    lives = live([0.0, 0.0, 0.0, 0.9], [0.9, 0.9, 0.9], tracks([0, 0, 0]))
    assert lives.obj_idxes.tolist() == [0, 0, 0]
    assert lives.max_obj_id.tolist() == [9]


def test_a_track_between_the_thresholds_waits() -> None:
    lives = live([0.0] * 4, [0.4, 0.37, 0.3], tracks([1, 2, 3], [2, 2, 2]))
    assert lives.obj_idxes.tolist() == [1, 2, 3]
    assert lives.disappear_time.tolist() == [0, 2, 3]


def test_a_track_ends_in_the_fifth_frame_out_of_sight() -> None:
    lives = live([0.0] * 4, [0.3, 0.3, 0.3], tracks([1, 2, 3], [3, 4, 0]))
    assert lives.obj_idxes.tolist() == [1, 3, 0]
    assert lives.disappear_time.tolist() == [4, 1, 0]


def test_without_a_free_slot_a_new_track_is_forgotten() -> None:
    lives = live([0.9, 0.0, 0.0, 0.0], [0.5, 0.5, 0.5], tracks([1, 2, 3]))
    assert lives.obj_idxes.tolist() == [1, 2, 3]


def parts(metres: list[float]) -> torch.Tensor:
    """Logits of a point in the range."""
    low, high = torch.tensor(RANGE[:3]), torch.tensor(RANGE[3:])
    return ((torch.tensor([metres]) - low) / (high - low)).logit()


def pose(yaw: float, x: float, y: float, seconds: float) -> LidarPose:
    """Of a lidar whose x axis is turned by yaw from the world's."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    axes = torch.tensor([[[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]])
    return LidarPose(axes, torch.tensor([[x, y, 0.0]]), torch.tensor([seconds]))


def test_a_standing_vehicle_carries_on_by_velocity_alone() -> None:
    still = pose(0.3, 5, 6, 1.0), pose(0.3, 5, 6, 1.5)
    velocity = torch.tensor([[4.0, -2.0]])
    carried = VelocityUpdate(RANGE)(parts([10, 20, -1]), velocity, *still)
    torch.testing.assert_close(carried, parts([12, 19, -1]), rtol=0, atol=1e-4)


def test_what_stands_is_seen_from_where_the_vehicle_is_now() -> None:
    """It went 3 m along its y and turned left by a quarter."""
    poses = pose(0, 0, 0, 0.0), pose(math.pi / 2, 0, 3, 0.5)
    carried = VelocityUpdate(RANGE)(parts([10, 20, 0]), torch.zeros(1, 2), *poses)
    torch.testing.assert_close(carried, parts([17, -10, 0]), rtol=0, atol=1e-4)
