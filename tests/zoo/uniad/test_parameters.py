import functools
from collections import Counter

import pytest
import torch

from me2e_compress.modules import ModuleMap
from me2e_compress.zoo.uniad.config import DL4AGX, UniadConfig
from me2e_compress.zoo.uniad.config import PUBLISHED as BENCH2DRIVE
from me2e_compress.zoo.uniad.stack import UniadTiny

PUBLISHED = {
    "backbone": 23_508_032,
    "neck": 3_278_592,
    "bev_encoder": 5_094_592,
    "track": 8_115_477,
    "map": 28_994_616,
    "motion": 13_769_783,
    "occ": 14_455_296,
    "planner": 3_624_588,
    None: 10,
}
"""Bench2DriveZoo's UniAD-tiny; the last are weights of the training loss."""

NEVER_READ = {
    "track": 814_176,
    "map": 10_240_000 + 6_452_791 + 530_448 + 7_710 + 12 * 74_016,
    "motion": 393_984,
}
"""Past trajectories; an embedding of the cells, the background head, branches of mask
heads, twelve attentions whose last three levels nothing feeds; a fuser of layers."""


LESS_IN_DL4AGX = {
    "neck": 3_278_592 - 1_114_624,
    "bev_encoder": (2_560_000 - 640_000) + (25_600 - 12_800) + 3 * (823_488 - 675_456),
    "track": -6 * 257,
    "map": (10_240_000 - 640_000) + 12 * 74_016 + (6 + 4) * 3 * 257,
    "motion": -6 * 256,
    "planner": 3 * 256,
}
"""One feature level of 2,048 channels: the neck and encoder layers of VAD-tiny. 2,500
cells in 50 rows and columns, in the map head too, and attention for one level there.
Ten classes of objects instead of nine, three of lanes and commands instead of six, four
groups of anchors instead of three."""


@functools.cache
def parameters(config: UniadConfig = BENCH2DRIVE, *, dead: bool) -> Counter[str | None]:
    modules = ModuleMap.load("uniad")
    with torch.device("meta"):
        model = UniadTiny(config, dead=dead)
    counts: Counter[str | None] = Counter()
    for name, parameter in model.named_parameters():
        counts[modules.match(name)] += parameter.numel()
    return counts


def test_parameters_are_the_published_ones() -> None:
    counts = parameters(dead=True)
    assert counts == PUBLISHED
    assert counts.total() == 100_840_986


@pytest.mark.parametrize("module", PUBLISHED)
def test_what_inference_never_reads_is_left_out(module: str | None) -> None:
    left = parameters(dead=False)[module]
    assert PUBLISHED[module] - left == NEVER_READ.get(module or "", 0)


@pytest.mark.parametrize("module", PUBLISHED)
def test_modules_of_dl4agx_differ_by_its_sizes(module: str | None) -> None:
    less = LESS_IN_DL4AGX.get(module or "", 0)
    assert parameters(DL4AGX, dead=True)[module] == PUBLISHED[module] - less


def test_dl4agx_holds_what_is_published() -> None:
    assert round(parameters(DL4AGX, dead=True).total() / 1e6, 3) == 85.807
