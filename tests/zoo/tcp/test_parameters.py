from collections import Counter

import pytest
import torch

from me2e_compress.modules import ModuleMap
from me2e_compress.zoo.tcp.config import ActionHeads
from me2e_compress.zoo.tcp.stack import Tcp

TRAINING = {
    "speed_branch": 322_305,
    "value_branch_traj": 131_841,
    "value_branch_ctrl": 131_841,
    "feature_branch_traj": 394_752,
    "feature_branch_ctrl": 394_752,
}
PERCEPTION = 21_797_672
OTHERS = 4_795_772
"""Published: the image trunk, and everything else with what only training reads."""


def parameters(heads: ActionHeads, *, training: bool) -> Counter[str]:
    with torch.device("meta"):
        model = Tcp(heads, training_branches=training)
    counts: Counter[str] = Counter()
    for name, parameter in model.named_parameters():
        counts[name] += parameter.numel()
    return counts


def test_parameters_are_the_published_ones() -> None:
    counts = parameters("bench2drive", training=True)
    trunk = sum(n for name, n in counts.items() if name.startswith("perception."))
    assert trunk == PERCEPTION
    assert counts.total() == PERCEPTION + OTHERS == 26_593_444


def test_what_only_training_reads_is_left_out_unless_asked_for() -> None:
    whole = parameters("bench2drive", training=True)
    whole.subtract(parameters("bench2drive", training=False))
    extra: Counter[str] = Counter()
    for name, count in whole.items():
        if count:
            extra[name.split(".")[0]] += count
    assert extra == TRAINING


@pytest.mark.parametrize(
    ("heads", "control"), [("bench2drive", 2_228_727), ("beta", 2_192_852)]
)
def test_every_parameter_has_a_module(heads: ActionHeads, control: int) -> None:
    """In `beta` the cell reads 4 numbers of an action, not 39, and two heads of 514."""
    modules = ModuleMap.load("tcp")
    counts: Counter[str | None] = Counter()
    for name, count in parameters(heads, training=False).items():
        counts[modules.match(name)] += count
    assert counts == {
        "backbone": PERCEPTION,
        "measurements": 17_792,
        "planner": 1_173_762,
        "control": control,
    }
