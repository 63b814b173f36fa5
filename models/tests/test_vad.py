from pathlib import Path

import onnx
import pytest
import torch

from models.export import example
from models.stacks import VAD_TINY
from models.tests.truth import count_macs
from models.vad.stack import VadTiny

pytestmark = pytest.mark.xdist_group("vad")

SHAPES = {
    "bev_embed": (10000, 1, 256),
    "all_cls_scores": (3, 1, 300, 10),
    "all_bbox_preds": (3, 1, 300, 10),
    "all_traj_preds": (3, 1, 300, 6, 12),
    "all_traj_cls_scores": (3, 1, 300, 6),
    "map_all_cls_scores": (3, 1, 100, 3),
    "map_all_bbox_preds": (3, 1, 100, 4),
    "map_all_pts_preds": (3, 1, 100, 20, 2),
    "ego_fut_preds": (1, 3, 6, 2),
}


@pytest.fixture(scope="module")
def published() -> VadTiny:
    """The module at its published size; it holds no numbers."""
    with torch.device("meta"):
        return VadTiny()


def test_outputs_have_the_published_shapes(published: VadTiny) -> None:
    with torch.no_grad():
        outputs = published(*(each.to("meta") for each in example(VAD_TINY)))
    shapes = zip(VAD_TINY.outputs, (tuple(each.shape) for each in outputs), strict=True)
    assert dict(shapes) == SHAPES


def test_macs_of_the_backbone_are_those_of_resnet_50(published: VadTiny) -> None:
    """4.087 G a 224 x 224 image without the classifier, six images 384 x 640."""
    macs = count_macs(VAD_TINY, published)
    expected = 4.087e9 * (384 * 640) / (224 * 224) * 6
    assert macs["backbone"] == pytest.approx(expected, rel=2e-3)
    assert macs["neck"] == 6 * 240 * (2048 * 256 + 9 * 256 * 256)


def test_no_tensor_is_constant(vad_torch: VadTiny) -> None:
    constant = [
        name
        for name, tensor in vad_torch.state_dict().items()
        if tensor.numel() > 1 and not bool((tensor != tensor.flatten()[0]).any())
    ]
    assert constant == []


def test_tensors_are_pairwise_distinct(vad_torch: VadTiny) -> None:
    seen: dict[bytes, str] = {}
    for name, tensor in vad_torch.state_dict().items():
        if name.endswith("num_batches_tracked"):
            continue
        other = seen.setdefault(tensor.numpy().tobytes(), name)
        assert other == name


def test_same_seed_same_bytes(vad_torch: VadTiny, vad_tiny: Path) -> None:
    """The export was built by itself, so its weights are a second draw."""
    weights = vad_torch.state_dict()
    for tensor in onnx.load(vad_tiny).graph.initializer:
        assert tensor.raw_data == weights[tensor.name].numpy().tobytes(), tensor.name
