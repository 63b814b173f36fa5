"""Normalizations behind layers that share one weight."""

from typing import Any

import numpy as np
import onnx_ir as ir
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.passes import PassResult
from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.small import apply, compute, ops, read
from tests.profiles import scaled

HEAD = '<ir_version: 9, opset_import: ["" : 17]>\n'


def levels(followers: str, channels: int, size: int) -> str:
    """One convolution over several images, each with its own follower.

    ``b``, ``c``: a normalization by the statistics of that letter; ``-``: none.
    """
    inputs = ", ".join(f"float[1,4,{size},{size}] x{i}" for i in range(len(followers)))
    outputs = ", ".join(
        f"float[1,{channels},{size},{size}] y{i}" for i in range(len(followers))
    )
    lines = []
    for i, letter in enumerate(followers):
        if letter == "-":
            lines.append(f"y{i} = Conv(x{i}, weight)")
            continue
        read = ", ".join(f"{part}_{letter}" for part in ("g", "d", "m", "v"))
        lines.append(f"a{i} = Conv(x{i}, weight)")
        lines.append(f"y{i} = BatchNormalization(a{i}, {read})")
    body = "\n".join(lines)
    return HEAD + f"g ({inputs}) => ({outputs}) {{ {body} }}"


def weights(followers: str, channels: int) -> dict[str, Any]:
    random = np.random.default_rng(0)
    found = {"weight": random.normal(size=(channels, 4, 1, 1)).astype(np.float32)}
    for letter in set(followers) - {"-"}:
        for part in ("g", "d", "m", "v"):
            drawn = random.uniform(0.5, 1.5, channels).astype(np.float32)
            found[f"{part}_{letter}"] = drawn
    return found


def fused(
    followers: str, channels: int = 4, size: int = 6
) -> tuple[ir.Model, ir.Model, PassResult]:
    text, arrays = levels(followers, channels, size), weights(followers, channels)
    before, after = read(text, **arrays), read(text, **arrays)
    return before, after, apply(FuseBasic(), after)


def test_layers_with_equal_statistics_go_on_sharing() -> None:
    before, after, _ = fused("bbb")

    assert ops(after) == ["Conv"] * 3
    assert len({node.inputs[1] for node in after.graph}) == 1
    assert graph.size(after).weight_bytes < graph.size(before).weight_bytes


def test_layers_with_statistics_of_their_own_get_copies() -> None:
    _, after, _ = fused("bcb")

    assert ops(after) == ["Conv"] * 3
    assert len({node.inputs[1] for node in after.graph}) == 2


def test_a_layer_that_nothing_follows_keeps_the_weight() -> None:
    _, after, _ = fused("b-")

    assert ops(after) == ["Conv"] * 2
    assert "weight" in after.graph.initializers


def test_copies_that_cost_more_than_their_nodes_are_worth_are_not_made() -> None:
    _, after, result = fused("bcde", channels=1024, size=1)

    assert ops(after).count("BatchNormalization") == 4
    assert "left 4: Conv that shares its weights" in result.notes


@settings(max_examples=scaled(25))
@given(st.text("bc-", min_size=1, max_size=4), st.integers(1, 5))
def test_whatever_follows_the_outputs_stay(followers: str, channels: int) -> None:
    before, after, _ = fused(followers, channels)

    assert "BatchNormalization" not in ops(after)
    feeds = {
        f"x{i}": np.random.default_rng(i).normal(size=(1, 4, 6, 6)).astype(np.float32)
        for i in range(len(followers))
    }
    for want, got in zip(compute(before, feeds), compute(after, feeds), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-5 * np.abs(want).max())


BEHIND = ("g", "d", "m", "v")


def unchanged(text: str, **given: Any) -> None:
    """Fuse; the outputs are what they were."""
    random = np.random.default_rng(5)
    before, after = read(text, **given), read(text, **given)
    apply(FuseBasic(), after)
    feeds = {
        str(port.name): random.normal(size=shape).astype(np.float32)
        for port in before.graph.inputs
        if (shape := graph.static_shape(port)) is not None
    }
    for want, got in zip(compute(before, feeds), compute(after, feeds), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-4)


def drawn(*shape: int) -> Any:
    return np.random.default_rng(1).uniform(0.5, 1.5, shape).astype(np.float32)


def test_a_copy_is_another_where_the_weight_was_scaled_in_place_since() -> None:
    text = (
        HEAD
        + """g (float[1,4,5,5] x1, float[1,4,5,5] x2)
        => (float[1,4,5,5] v11, float[1,4,5,5] v24) {
        v7 = Conv(x1, W, b)
        v9 = Conv(x2, W)
        v11 = Div(v7, two)
        v17 = BatchNormalization(v9, g, d, m, v)
        v24 = Div(v17, two)
    }"""
    )
    unchanged(
        text, W=drawn(4, 4, 1, 1), b=drawn(4), two=np.float32(2),
        **{name: drawn(4) * (1 + i) for i, name in enumerate(BEHIND)},
    )  # fmt: skip


def test_a_copy_is_another_where_it_was_scaled_in_place_itself() -> None:
    text = (
        HEAD
        + """g (float[1,4,5,5] x1, float[1,4,5,5] x2, float[1,4,5,5] x3)
        => (float[1,4,5,5] c, float[1,4,5,5] y2, float[1,4,5,5] x) {
        a = Conv(x1, W)
        b = Mul(a, two)
        c = BatchNormalization(b, g, d, m, v)
        a2 = Conv(x2, W)
        y2 = Mul(a2, two)
        x = Conv(x3, W)
    }"""
    )
    unchanged(
        text, W=drawn(4, 4, 1, 1), two=np.float32(2),
        **{name: drawn(4) * (1 + i) for i, name in enumerate(BEHIND)},
    )  # fmt: skip


def test_a_transposed_weight_has_copies_of_its_own() -> None:
    text = (
        HEAD
        + """g (float[3,4] x1, float[3,4] x2, float[3,4] x3)
        => (float[3,4] y1, float[3,4] y2, float[3,4] y3) {
        a1 = Gemm(x1, W, b)
        y1 = Mul(a1, k)
        a2 = Gemm<transB = 1>(x2, W, b)
        y2 = Mul(a2, k)
        a3 = MatMul(x3, W)
        y3 = Mul(a3, k)
    }"""
    )
    unchanged(text, W=drawn(4, 4), b=drawn(4), k=drawn(4))
