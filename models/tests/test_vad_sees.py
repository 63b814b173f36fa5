"""What VAD-tiny's random weights see."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.stacks import VAD_TINY
from models.synthetic_frames import Frame
from models.vad.stack import VadTiny

pytestmark = pytest.mark.xdist_group("vad")

COMMAND = VAD_TINY.heads["nuscenes"]


class Seen:
    """Drives from camera features, so that images are encoded once."""

    def __init__(
        self, model: VadTiny, scenes: list[Frame], no_bev: NDArray[np.float32]
    ) -> None:
        self.model = model
        self.scenes = scenes
        self.no_bev = torch.from_numpy(no_bev)
        self.features = [self._features(scenes[index]) for index in (0, 2)]
        self.first = self.drive(self.features[0])

    @torch.no_grad()
    def _features(self, frame: Frame) -> Tensor:
        images = torch.from_numpy(frame["img"])[0]
        out: list[Tensor] = self.model.img_neck([self.model.img_backbone(images)])
        return out[0]

    @torch.no_grad()
    def drive(self, features: Tensor, index: int = 0) -> dict[str, Tensor]:
        frame = self.scenes[index]
        outputs = self.model.pts_bbox_head(
            features,
            torch.from_numpy(frame["lidar2img"]),
            torch.from_numpy(frame["can_bus"]),
            self.no_bev,
        )
        return dict(zip(VAD_TINY.outputs, outputs, strict=True))

    def shift(self, other: dict[str, Tensor]) -> float:
        """Relative change of the driven plan."""
        plans = [
            outputs["ego_fut_preds"][0, COMMAND].cumsum(0)
            for outputs in (self.first, other)
        ]
        return float((plans[0] - plans[1]).norm() / plans[0].norm())


@pytest.fixture(scope="module")
def seen(
    vad_torch: VadTiny, vad_scenes: list[Frame], no_bev: NDArray[np.float32]
) -> Seen:
    return Seen(vad_torch, vad_scenes, no_bev)


@pytest.mark.parametrize("camera", range(6))
def test_every_camera_moves_the_plan(seen: Seen, camera: int) -> None:
    features = seen.features[0].clone()
    features[camera] = seen.features[1][camera]
    assert seen.shift(seen.drive(features)) >= 0.05


def test_another_scene_gives_another_plan(seen: Seen) -> None:
    assert seen.shift(seen.drive(seen.features[1], 2)) >= 0.1


def test_noise_moves_the_plan_less_than_any_camera(seen: Seen) -> None:
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(seen.features[0].shape, generator=generator)
    assert seen.shift(seen.drive(seen.features[0] + 0.01 * noise)) < 0.02


def test_activations_are_of_unit_size(seen: Seen) -> None:
    bev = seen.first["bev_embed"]
    assert 0.5 < float(bev.std()) < 2
    for features in seen.features:
        assert 0.5 < float(features.std()) < 2
    for name, value in seen.first.items():
        assert bool(value.isfinite().all()), name
        assert float(value.abs().max()) < 100, name


def test_map_mask_keeps_some_vectors_and_drops_others(seen: Seen) -> None:
    likely = seen.first["map_all_cls_scores"][-1].sigmoid().amax(-1) > 0.5
    assert 0.1 < float(likely.float().mean()) < 0.95
