"""Encoders of the ego car's status are known, and stay float by default."""

import numpy as np
import pytest

from me2e_compress.quantization.plan import Decision
from tests.nets import by_output, net, planned

NET = """ego (float[3,18] can_bus, float[1,3,%d,32] image, float[3,32] memory,
     float[18,32] a, float[32,32] b, float[32,64] c, float[64,32] d,
     float[500,32] grid) => (float y, float z, float memory_out)
    <int64[2] rows = {3, 32}, int64[2] cells = {32, -1}> {
    e = MatMul(can_bus, a)
    r = Relu(e)
    f = MatMul(r, b)
    m = MatMul(memory, b)
    memory_out = Identity(m)
    pixels = Reshape(image, cells)
    s = MatMul(f, pixels)
    first = ReduceMean<axes = [0], keepdims = 1>(f)
    map = Add(first, grid)
    y = MatMul(map, c)
    i = ReduceMean<axes = [2, 3], keepdims = 0>(image)
    t = ReduceMean<keepdims = 1>(i)
    k = Add(f, t)
    z = MatMul(k, c)
}"""
SIZES = {"a": (18, 32), "b": (32, 32), "c": (32, 64), "d": (64, 32), "grid": (500, 32)}


def decisions(height: int, rule_set: str) -> dict[str, Decision]:
    model = net(NET % height, {name: np.ones(size) for name, size in SIZES.items()})
    return by_output(planned(model, rule_set))


def rules(height: int, rule_set: str) -> dict[str, str]:
    return {name: each.rule for name, each in decisions(height, rule_set).items()}


def test_layers_that_see_the_status_alone_stay_float() -> None:
    found = rules(32, "safe")

    assert (found["e"], found["f"]) == ("ego-input", "ego-input")


@pytest.mark.parametrize(
    ("output", "why"),
    [
        ("m", "a memory is no status"),
        ("y", "a map that the status was added to is a map"),
        ("z", "it sees the image too"),
    ],
)
def test_other_layers_do_not(output: str, why: str) -> None:
    assert rules(32, "safe")[output] == "layer", why


def test_a_graph_without_sensors_has_no_status() -> None:
    assert rules(1, "safe")["e"] == "layer"


def test_other_rules_flag_it() -> None:
    found = decisions(32, "paper")

    flagged = {name: each for name, each in found.items() if each.borderline}
    assert set(flagged) == {"e", "f"}
    assert all(each.dtype == "int8" for each in flagged.values())
    assert "ego-input: encodes the ego status can_bus" in flagged["e"].borderline
    assert "rules safe keep it float" in flagged["e"].borderline
