"""GridSample as deformable attention of rows of channels, against float64."""

from typing import Any
from unittest.mock import Mock

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.operators.grid_sampler import grid_sample_array
from me2e_compress.passes.fuse_kernels import FuseKernels, grid_sample
from me2e_compress.passes.fused_nodes import ExpandOperators
from tests.passes.small import apply, compute, ops, read

RANDOM = np.random.default_rng(7)
KERNEL = "MultiScaleDeformableAttention"
MODES = {"bilinear": 0, "nearest": 1}


@pytest.fixture(autouse=True)
def open_gate(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "gate" not in request.node.name:
        monkeypatch.setattr(grid_sample, "pays", Mock(return_value=True))


@pytest.mark.parametrize(
    ("mode", "channels", "side", "points", "rows", "is_fused"),
    [
        ("nearest", 16, 16, 768, True, True),
        ("bilinear", 16, 16, 768, True, False),  # few channels
        ("bilinear", 64, 16, 768, True, True),
        ("nearest", 64, 100, 16, False, False),  # all of a large map is turned
        ("nearest", 64, 100, 10000, False, True),
    ],
)
def test_the_gate_knows_sizes(
    mode: str, channels: int, side: int, points: int, rows: bool, is_fused: bool
) -> None:
    shape = (side, side, channels) if rows else (channels, side, side)
    body = (ROWS if rows else "m = Identity(x) ") + sample(mode) + " y = Neg(s)"
    image, out = ",".join(map(str, (1, *shape))), f"1,{channels},1,{points}"
    result = apply(FuseKernels(), model_of(image, f"1,1,{points},2", body, out))
    assert result.changes == is_fused
    assert is_fused or "its nodes are as fast" in result.notes[0]


def model_of(
    image: str, places: str, body: str, out: str, *, rank: int = 4, opset: int = 17
) -> ir.Model:
    """Read a graph that samples ``m``, which the body makes of ``x``, to ``s``."""
    return read(
        f'<ir_version: 9, opset_import: ["" : {opset}]>\n'
        f"g (float[{image}] x, float[{places}] at) => (float[{out}] y) {{ {body} }}"
    )


def sample(mode: str = "bilinear", padding: str = "zeros", corners: int = 0) -> str:
    return (
        f's = GridSample<mode = "{mode}", padding_mode = "{padding}",'
        f" align_corners = {corners}>(m, at)"
    )


def positions(batch: int, height: int, width: int, count: int) -> Any:
    """Draw positions inside and around a map, none near a tie of nearest pixels."""
    size = np.array([width, height])
    pixels = RANDOM.integers(-2, size + 2, (batch, count, 3, 2))
    places = pixels + RANDOM.uniform(-0.45, 0.45, pixels.shape)
    return ((2 * places + 1) / size - 1).astype(np.float32)


def wanted(image: Any, at: Any, mode: str) -> Any:
    options = {"interpolation_mode": MODES[mode], "padding_mode": 0, "align_corners": 0}
    return grid_sample_array((image, at), options)


def result(model: ir.Model, x: Any, at: Any) -> Any:
    apply(ExpandOperators(), model)
    return compute(model, {"x": x, "at": at})[0]


@settings(max_examples=25)
@given(
    st.sampled_from(sorted(MODES)), st.integers(1, 2),
    st.tuples(st.integers(1, 5), st.integers(1, 5)), st.integers(1, 4),
    st.sampled_from(("rows", "image")), st.sampled_from(("rows", "image")),
)  # fmt: skip
def test_any_map_keeps_its_samples(
    mode: str, n: int, size: tuple[int, int], count: int, given_as: str, read_as: str
) -> None:
    (h, w), c = size, 16
    shape = (n, h, w, c) if given_as == "rows" else (n, c, h, w)
    x, at = RANDOM.normal(size=shape).astype(np.float32), positions(n, h, w, count)
    image = x.transpose(0, 3, 1, 2) if given_as == "rows" else x
    want = wanted(image, at, mode)
    turn = "m = Transpose<perm = [0, 3, 1, 2]>(x) "
    body = turn if given_as == "rows" else "m = Identity(x) "
    body += sample(mode)
    out = (n, c, count, 3)
    if read_as == "rows":
        out = (n, count, 3, c)
        body += " y = Transpose<perm = [0, 2, 3, 1]>(s)"
        want = want.transpose(0, 2, 3, 1)
    else:
        body += " y = Neg(s)"
        want = -want
    texts = (",".join(map(str, each)) for each in (x.shape, at.shape, out))
    image_text, places, out_text = texts
    model = model_of(image_text, places, body, out_text)

    changes = apply(FuseKernels(), model).changes

    assert changes == int(mode == "nearest" or "rows" in (given_as, read_as))
    np.testing.assert_allclose(result(model, x, at), want, rtol=0, atol=2e-5)


BEV = (
    "turned = Transpose<perm = [1, 2, 0]>(x)"
    " shape = Constant<value_ints = [1, 16, 6, 5]>() m = Reshape(turned, shape) "
    + sample("nearest")
    + " flat = Constant<value_ints = [1, 16, -1]>() r = Reshape(s, flat)"
    " y = Transpose<perm = [0, 2, 1]>(r)"
)


def test_a_view_of_rows_is_rotated_without_a_transposition() -> None:
    """As BEVFormer rotates the view of the last frame, [H W, 1, C]."""
    model = model_of("30,1,16", "1,6,5,2", BEV, "1,30,16")
    rows = RANDOM.normal(size=(30, 1, 16)).astype(np.float32)
    at = positions(1, 6, 5, 10).reshape(1, 6, 5, 2)
    image = rows.reshape(6, 5, 16).transpose(2, 0, 1)[None]
    want = wanted(image, at, "nearest").reshape(1, 16, 30).transpose(0, 2, 1)

    assert apply(FuseKernels(), model).notes == ("fused: 1 GridSample",)

    assert KERNEL in ops(model)
    assert {"Transpose", "GridSample"}.isdisjoint(ops(model))
    np.testing.assert_allclose(result(model, rows, at), want, rtol=0, atol=2e-5)


def test_another_reader_gets_the_map_as_it_was() -> None:
    body = sample() + " t = Transpose<perm = [0, 2, 3, 1]>(s) u = Neg(t)"
    model = read(
        "g (float[1,16,4,4] m, float[1,2,3,2] at)"
        f" => (float[1,16,2,3] s, float[1,2,3,16] u) {{ {body} }}"
    )
    m, at = RANDOM.normal(size=(1, 16, 4, 4)), positions(1, 4, 4, 2)
    m = m.astype(np.float32)
    want = wanted(m, at, "bilinear")
    assert apply(FuseKernels(), model).changes == 1
    apply(ExpandOperators(), model)
    got = compute(model, {"m": m, "at": at})
    np.testing.assert_allclose(got[0], want, rtol=0, atol=2e-5)
    np.testing.assert_allclose(got[1], -want.transpose(0, 2, 3, 1), rtol=0, atol=2e-5)


ROWS = "m = Transpose<perm = [0, 3, 1, 2]>(x) "
LEFT = {
    "it samples bicubic": ROWS + sample("bicubic"),
    "it pads with border, not zeros": ROWS + sample(padding="border"),
    "it aligns corners": ROWS + sample(corners=1),
    "bilinear, and channels are not side by side": (
        "m = Transpose<perm = [0, 3, 2, 1]>(x) " + sample()  # columns for rows
    ),
}


@pytest.mark.parametrize("reason", LEFT)
def test_near_misses_are_left_alone(reason: str) -> None:
    body = LEFT[reason] + " y = Neg(s)"
    result = apply(FuseKernels(), model_of("1,4,4,16", "1,2,3,2", body, "1,16,2,3"))
    assert result.changes == 0
    assert result.notes[0].endswith(f": {reason}")


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        ("1,4,4,15", "15 channels, below 16"),
        ("1,h,4,16", "sizes are unknown, or it samples a volume"),
    ],
)
def test_sizes_that_do_not_fit(image: str, reason: str) -> None:
    body = ROWS + sample() + " y = Neg(s)"
    channels = image.rpartition(",")[2]
    model = model_of(image, "1,2,3,2", body, f"1,{channels},2,3")
    result = apply(FuseKernels(), model)
    assert (result.changes, result.notes[0].endswith(f": {reason}")) == (0, True)
