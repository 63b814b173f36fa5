from collections import Counter
from pathlib import Path

import onnx
import pytest
import torch
from torch import nn

from me2e_compress.zoo.export import example
from me2e_compress.zoo.stacks import VAD_TINY
from me2e_compress.zoo.vad.config import HeadsName
from me2e_compress.zoo.vad.stack import VadTiny
from tests.zoo.truth import count_macs
from tests.zoo.vad.sizes import SIZES, VadSize

pytestmark = pytest.mark.xdist_group("vad")

PARTS = {
    "backbone": ("img_backbone.",),
    "neck": ("img_neck.",),
    "bev_encoder": (
        "bev_embedding.",
        "positional_encoding.",
        "transformer.encoder.",
        "transformer.can_bus_mlp.",
        "transformer.level_embeds",
        "transformer.cams_embeds",
    ),
    "det": (
        "transformer.decoder.",
        "transformer.reference_points.",
        "query_embedding.",
        "cls_branches.",
        "reg_branches.",
    ),
    "map": (
        "transformer.map_decoder.",
        "transformer.map_reference_points.",
        "map_instance_embedding.",
        "map_pts_embedding.",
        "map_cls_branches.",
        "map_reg_branches.",
    ),
    "motion": (
        "motion_decoder.",
        "motion_mode_query.",
        "pos_mlp_sa.",
        "lane_encoder.",
        "motion_map_decoder.",
        "pos_mlp.",
        "traj_branches.",
        "traj_cls_branches.",
    ),
    "planner": (
        "ego_query.",
        "ego_agent_decoder.",
        "ego_agent_pos_mlp.",
        "ego_map_decoder.",
        "ego_map_pos_mlp.",
        "agent_fus_mlp.",
        "ego_fut_decoder.",
    ),
    "code_weights": ("code_weights", "map_code_weights"),
}

NUSCENES = {
    "backbone": 23_508_032,
    "neck": 1_114_624,
    "bev_encoder": 4_650_496,
    "det": 3_013_983,
    "map": 2_910_001,
    "motion": 2_216_077,
    "planner": 2_452_772,
    "code_weights": 14,
}
BENCH2DRIVE = NUSCENES | {
    "det": NUSCENES["det"] - 3 * 257,
    "map": NUSCENES["map"] + 3 * 3 * 257,
    "planner": NUSCENES["planner"] + 3 * 12 * 513,
}


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


def part_of(name: str) -> str:
    short = name.removeprefix("pts_bbox_head.")
    (part,) = [part for part, starts in PARTS.items() if short.startswith(starts)]
    return part


@pytest.mark.parametrize(
    ("heads", "parts", "total"),
    [
        ("nuscenes", NUSCENES, 39_865_999),
        ("bench2drive", BENCH2DRIVE, 39_886_009),
    ],
)
def test_parameters_are_the_published_ones(
    heads: HeadsName, parts: dict[str, int], total: int
) -> None:
    counts: Counter[str] = Counter()
    with torch.device("meta"):
        model = VadTiny(heads)
    for name, parameter in model.named_parameters():
        counts[part_of(name)] += parameter.numel()
    assert dict(counts) == parts
    assert counts.total() == total


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_the_interface_has_the_sizes_of_the_configuration(size: VadSize) -> None:
    inputs, config = size.stack.inputs, size.config
    assert inputs["img"] == (1, 6, 3, *config.image_hw)
    assert inputs["prev_bev"] == (config.grid.cells, 1, 256)


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


def test_published_scopes_exist(published: VadTiny) -> None:
    names = dict(published.named_modules())
    for scope in (
        "img_backbone.layer1.0.conv1",
        "img_backbone.layer4.0.downsample.0",
        "img_neck.lateral_convs.0.conv",
        "img_neck.fpn_convs.0.conv",
        "pts_bbox_head.transformer.encoder.layers.0.attentions.1.deformable_attention",
        "pts_bbox_head.transformer.decoder.layers.2.attentions.1.value_proj",
        "pts_bbox_head.transformer.map_decoder.layers.2.ffns.0.layers.0.0",
        "pts_bbox_head.transformer.can_bus_mlp.norm",
        "pts_bbox_head.ego_map_decoder.layers.0.attentions.0.attn",
        "pts_bbox_head.lane_encoder.layer_seq.lmlp_2.linear",
        "pts_bbox_head.cls_branches.2.6",
        "pts_bbox_head.traj_branches.0.4",
    ):
        assert scope in names


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


def test_attention_blocks_have_the_published_sizes(published: VadTiny) -> None:
    layer = published.pts_bbox_head.transformer.encoder.layers[0]
    blocks = ("attentions.0", "attentions.1", "ffns.0", "")
    sizes = [_size(layer.get_submodule(block)) for block in blocks]
    assert sizes == [230_080, 180_928, 262_912, 675_456]


def _size(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_same_seed_same_bytes(vad_torch: VadTiny, vad_tiny: Path) -> None:
    """The export was built by itself, so its weights are a second draw."""
    weights = vad_torch.state_dict()
    for tensor in onnx.load(vad_tiny).graph.initializer:
        assert tensor.raw_data == weights[tensor.name].numpy().tobytes(), tensor.name
