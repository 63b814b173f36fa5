"""Parameters of the stacks, against what their originals publish."""

from collections import Counter

import pytest
import torch

from me2e_compress.graph.modules.module_map import ModuleMap
from models.construct import construct
from models.stacks import STACKS

VAD: dict[str | None, int] = {
    "backbone": 23_508_032,
    "neck": 1_114_624,
    "bev_encoder": 4_650_496,
    "det": 3_013_983,
    "map": 3_009_457,
    "motion": 2_116_621,
    "planner": 2_452_772,
    None: 14,
}
UNIAD: dict[str | None, int] = {
    "backbone": 23_508_032,
    "neck": 3_278_592,
    "bev_encoder": 5_094_592,
    "track": 7_301_301,
    "map": 11_763_667,
    "motion": 13_375_799,
    "occ": 14_455_296,
    "planner": 3_624_588,
    None: 10,
}
TCP: dict[str | None, int] = {
    "backbone": 21_797_672,
    "measurements": 17_792,
    "planner": 1_173_762,
    "control": 2_228_727,
}
MODULES = {
    ("vad-tiny", "nuscenes"): VAD,
    # one class of objects less, three of lanes and three commands more
    ("vad-tiny", "bench2drive"): VAD
    | {
        "det": VAD["det"] - 3 * 257,
        "map": VAD["map"] + 3 * 3 * 257,
        "planner": VAD["planner"] + 3 * 12 * 513,
    },
    ("uniad-tiny", None): UNIAD,
    # one feature level of 2,048 channels, and 2,500 cells; other classes and commands
    ("uniad-trt", None): UNIAD
    | {
        "neck": VAD["neck"],
        "bev_encoder": UNIAD["bev_encoder"]
        - (2_560_000 - 640_000)
        - (25_600 - 12_800)
        - 3 * (823_488 - 675_456),
        "track": UNIAD["track"] + 6 * 257,
        "map": UNIAD["map"] - 12 * 74_016 - 6 * 3 * 257,
        "motion": UNIAD["motion"] + 6 * 256,
        "planner": UNIAD["planner"] - 3 * 256,
    },
    ("tcp", "bench2drive"): TCP,
    # the cell reads 4 numbers of an action, not 39, and there are two heads of 514
    ("tcp", "beta"): TCP | {"control": 2_192_852},
}


@pytest.mark.parametrize(("stack", "heads"), MODULES)
def test_every_module_has_the_published_parameters(
    stack: str, heads: str | None
) -> None:
    modules = ModuleMap.load(stack.partition("-")[0])
    with torch.device("meta"):
        model = construct(STACKS[stack].with_heads(heads))
    counts: Counter[str | None] = Counter()
    for name, parameter in model.named_parameters():
        counts[modules.match(name)] += parameter.numel()
    assert counts == MODULES[stack, heads]


@pytest.mark.parametrize(
    ("stack", "heads", "left_out", "total"),
    [
        ("vad-tiny", "nuscenes", 0, 39_865_999),
        ("vad-tiny", "bench2drive", 0, 39_886_009),
        # past trajectories, a fuser of layers, an embedding of the map's cells, its
        # background head, and branches of its mask heads
        (
            *("uniad-tiny", None),
            814_176 + 393_984 + 10_240_000 + 6_452_791 + 530_448 + 7_710,
            100_840_986,
        ),
        (
            *("uniad-trt", None),
            814_176 + 393_984 + 640_000 + 6_452_791 + 530_448 + (4 * 3 + 6) * 257,
            85_806_530,
        ),
        ("tcp", "bench2drive", 322_305 + 2 * 131_841 + 2 * 394_752, 26_593_444),
    ],
)
def test_with_what_inference_never_reads_there_are_as_many_as_published(
    stack: str, heads: str | None, left_out: int, total: int
) -> None:
    assert sum(MODULES[stack, heads].values()) + left_out == total
