"""Names and shapes in published checkpoints.

They were written down from hustvl/VAD, configs/VAD/VAD_tiny_e2e.py; Bench2DriveZoo,
adzoo/uniad/configs/stage2_e2e/tiny_e2e_b2d.py; and OpenDriveLab/TCP with
Bench2DriveZoo's branch tcp/admlp. Here are digests of these lists by module.
"""

import functools
import hashlib
from collections import defaultdict

import torch

from models.construct import construct
from models.published_names import PUBLISHED
from models.stacks import STACKS

Shapes = dict[str, tuple[int, ...]]

_VAD = {"img_backbone": "318 4a47720db7b1", "img_neck": "4 a8a63f803f6d"}
_TCP = {
    "decoder_traj": "4 df7af0c7297a",
    "init_att": "4 e931ef8cada2",
    "join_ctrl": "6 44de8ab21b74",
    "join_traj": "6 1d3b1c1564e2",
    "measurements": "4 e173b9d806a6",
    "merge": "4 df0e935c1505",
    "output_ctrl": "4 45d602473ddc",
    "output_traj": "2 99402dddf3ed",
    "perception": "218 06a33788f1c6",
    "policy_head": "4 1faefc2cd5b1",
    "wp_att": "4 8e0be152991e",
}
DIGESTS = {
    ("vad-tiny", "nuscenes"): _VAD | {"pts_bbox_head": "424 75c320fda4d0"},
    ("vad-tiny", "bench2drive"): _VAD | {"pts_bbox_head": "424 71a9c16af71e"},
    # its motion anchors, in a file of their own, are among the tensors of the head
    ("uniad-tiny", None): {
        "img_backbone": "318 4a47720db7b1",
        "img_neck": "14 1126dc6f0585",
        "memory_bank": "14 46145e0bca41",
        "motion_head": "256 a971c7cff997",
        "occ_head": "380 991ba5bbf5cf",
        "planning_head": "76 23090e344520",
        "pts_bbox_head": "318 1dc7570ad078",
        "query_embedding": "1 6ab077b937c7",
        "query_interact": "24 d5cab24514d3",
        "reference_points": "2 99bad910bacb",
        "seg_head": "368 4e4a926cc6f1",
    },
    ("tcp", "bench2drive"): _TCP
    | {"action_head": "2 aed0d88f4769", "decoder_ctrl": "4 869d23155f81"},
    ("tcp", "beta"): _TCP
    | {
        "decoder_ctrl": "4 22bc9b3a6db5",
        "dist_mu": "2 c3f10148628b",
        "dist_sigma": "2 6ad90ae6fc5c",
    },
}
"""Number and SHA-256 of the tensors that driving reads, by the first of their names."""

SCORERS = ("speed_branch", "value_branch_traj", "value_branch_ctrl")
LAYERS: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(SCORERS, (0, 2, 5)),
    **dict.fromkeys(("feature_branch_traj", "feature_branch_ctrl"), (0,)),
}
TRAINING = {
    "tcp": [
        f"{branch}.{layer}.{kind}"
        for branch, layers in LAYERS.items()
        for layer in layers
        for kind in ("weight", "bias")
    ],
    "uniad-tiny": [
        "criterion.code_weights",
        "motion_head.layer_track_query_fuser.0.weight",
        "pts_bbox_head.past_traj_reg_branches.5.4.bias",
        "seg_head.bev_embedding.weight",
        "seg_head.cls_stuff_branches.5.bias",
        "seg_head.cls_thing_branches.3.weight",
        "seg_head.reg_branches2.3.4.weight",
        "seg_head.stuff_mask_head.blocks.5.self_attention.qkv.weight",
        "seg_head.stuff_query.weight",
    ],
}
"""Names that only training reads: all of TCP's, and one of each module of UniAD's."""


@functools.cache
def _named(stack: str, heads: str | None) -> Shapes:
    with torch.device("meta"):
        model = construct(STACKS[stack].with_heads(heads))
    names = PUBLISHED[stack]
    return {
        names.published(name): tuple(each.shape)
        for name, each in model.state_dict().items()
        if not names.is_computed(name)
    }


def published(stack: str, heads: str | None = None) -> Shapes:
    """What a checkpoint of the original holds, with some that only training reads."""
    return _named(stack, heads) | dict.fromkeys(TRAINING.get(stack, ()), (1,))


def digests(shapes: Shapes) -> dict[str, str]:
    """Count and digest names and shapes by the first part of the names."""
    parts = defaultdict[str, list[str]](list)
    for name, shape in sorted(shapes.items()):
        parts[name.partition(".")[0]].append(f"{name} {list(shape)}")
    found = {p: hashlib.sha256("\n".join(rows).encode()) for p, rows in parts.items()}
    return {p: f"{len(parts[p])} {each.hexdigest()[:12]}" for p, each in found.items()}
