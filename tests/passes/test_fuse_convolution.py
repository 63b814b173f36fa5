"""Convolutions that ``fuse-kernels`` gives to Winograd's algorithm."""

from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.graph import static_shape
from me2e_compress.passes.fuse_kernels import FuseKernels
from me2e_compress.runtime.session import Session
from tests.passes.small import apply, compute, ops, read

RANDOM = np.random.default_rng(11)
FUSED = "WinogradConvolution"
PADS = "pads = [1, 1, 1, 1]"


def normal(*shape: int) -> Any:
    return (RANDOM.normal(size=shape) / 24).astype(np.float32)


WEIGHT, BIAS = normal(64, 64, 3, 3), normal(64)


def graph(
    *lines: str,
    given: str = "float[2,64,48,40] x",
    out: str = "float[N,K,A,B] y",
    **weights: Any,
) -> ir.Model:
    body = "\n  ".join(lines)
    text = f"g ({given}) => ({out}) {{\n  {body}\n}}"
    return read(text, **{"w": WEIGHT, "b": BIAS, **weights})


def check(model: ir.Model, *left: str) -> tuple[str, ...]:
    """Fuse; compare operators, and values with those before. Return the notes."""
    before = model.clone()
    result = apply(FuseKernels(), model)
    assert ops(model) == list(left)
    port = before.graph.inputs[0]
    feeds = {"x": normal(*(static_shape(port) or ()))}
    found = Session(model, threads=1).run(feeds)
    for port, want in zip(before.graph.outputs, compute(before, feeds), strict=True):
        got = np.asarray(found[port.name or ""], np.float32)
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-4 * np.abs(want).max())
    return result.notes


def test_with_a_relu_behind_it() -> None:
    model = graph(f"c = Conv<{PADS}>(x, w, b)", "y = Relu(c)")

    assert check(model, FUSED) == ("fused: 1 Relu",)
    assert model.graph[0].attributes["relu"].as_int() == 1
    check(graph("y = Conv<pads = [0, 1, 2, 0]>(x, w)"), FUSED)  # and no bias


def test_a_relu_is_not_fused_where_more_is_read() -> None:
    lines = f"c = Conv<{PADS}>(x, w, b)", "y = Relu(c)"
    out = "float[N,K,A,B] y, float[N,K,A,B] "

    check(graph(*lines, out=f"{out}c"), FUSED, "Relu")
    check(graph(*lines, "z = Abs(c)", out=f"{out}z"), FUSED, "Relu", "Abs")


@pytest.mark.parametrize(
    "line",
    [
        f"y = Conv<{PADS}, strides = [2, 2]>(x, w, b)",
        "y = Conv<pads = [2, 2, 2, 2], dilations = [2, 2]>(x, w, b)",
        f"y = Conv<{PADS}, group = 2>(x, half, b)",
        'y = Conv<auto_pad = "SAME_UPPER">(x, w, b)',
        "y = Conv(x, one)",
        "v = Abs(w)\n  y = Conv(x, v)",
    ],
)
def test_others_are_left_without_a_word(line: str) -> None:
    weights = {"half": normal(64, 32, 3, 3), "one": normal(64, 64, 1, 1)}
    model = graph(line, **weights)

    assert check(model, *ops(model)) == ()


@pytest.mark.parametrize("given", ["float[1,64,8,8] x", "float[2,64,9,40] x"])
def test_small_images_are_left(given: str) -> None:
    check(graph(f"y = Conv<{PADS}>(x, w, b)", given=given), "Conv")
    unknown = graph(f"y = Conv<{PADS}>(x, w, b)", given="float[2,64,H,40] x")
    notes = ("left n0: the size of its image is not known",)
    assert apply(FuseKernels(), unknown).notes == notes


def test_a_sum_with_a_shortcut_makes_it_pay_less() -> None:
    lines = f"c = Conv<{PADS}>(x, w, b)", "s = Add(c, x)", "y = Relu(s)"

    check(graph(*lines), FUSED, "Add", "Relu")
    check(graph(*lines, given="float[1,64,56,56] x"), "Conv", "Add", "Relu")
    check(graph(f"y{lines[0][1:]}", given="float[1,64,56,56] x"), FUSED)
