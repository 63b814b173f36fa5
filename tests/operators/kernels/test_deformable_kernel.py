"""Deformable attention in a session: its kernel against its float64 reference."""

from typing import Any

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.operators import Dialect
from me2e_compress.operators.deformable_attention import DeformableAttention
from me2e_compress.runtime import runnable
from me2e_compress.runtime.session import Session
from me2e_compress.testing.check_operator import DrawnCall, dialect_reference
from tests.operators.kernels import needs_kernels
from tests.operators.running import graph_of, in_float32
from tests.operators.test_deformable_attention import arrays_of
from tests.support.profiles import scaled

pytestmark = needs_kernels

OPERATOR = DeformableAttention()
RAW = DeformableAttention.dialects[-1]
calls = st.fixed_dictionaries(
    {
        "sizes": st.lists(
            st.tuples(st.integers(0, 5), st.integers(0, 6)), min_size=1, max_size=3
        ),
        "batch": st.integers(1, 3),
        "queries": st.sampled_from([1, 3, 300]),
        "heads": st.integers(1, 3),
        "width": st.sampled_from([1, 5, 8, 23, 32, 67]),
        "points": st.sampled_from([2, 4]),
        "group": st.just(2),
        "seed": st.integers(0, 1000),
    }
)


@settings(max_examples=scaled(20))
@given(
    dialect=st.sampled_from(OPERATOR.all_dialects()),
    call=calls,
    open_dims=st.booleans(),
)
def test_every_dialect_answers_its_reference(
    dialect: Dialect, call: dict[str, Any], open_dims: bool
) -> None:
    arrays = arrays_of(dialect, call)
    # what takes no index of the levels must know how many there are
    known = ["spatial_shapes"] if "level_start_index" not in arrays else []
    model = graph_of(
        dialect, arrays, opset=17, constants=known, open_dims=open_dims and not known
    )
    _, needed = runnable.replace_fused(model, compiled=True)
    assert needed

    result = Session(model, threads=1).run(arrays)["result"]

    expected = dialect_reference(OPERATOR, dialect, DrawnCall(arrays))
    assert np.allclose(result, expected, rtol=1e-4, atol=1e-4)


def test_what_has_no_weight_is_not_read() -> None:
    random = np.random.default_rng(5)
    inputs: dict[str, Any] = {
        "value": random.normal(size=(2, 63, 3, 8)).astype(np.float32),
        "spatial_shapes": np.array([[5, 11], [2, 4]], np.int32),
        "level_start_index": np.array([0, 55], np.int32),
        "sampling_locations": random.uniform(-0.2, 1.2, (2, 300, 3, 2, 4, 2)),
        "attention_weights": random.uniform(0, 1, (2, 300, 3, 2, 4)),
    }
    arrays = in_float32(inputs)
    weights = arrays["attention_weights"]
    weights[random.uniform(size=weights.shape) < 0.6] = 0
    weights[:, :, :, 1] = 0  # a camera that nobody looks at
    expected = OPERATOR.reference(list(arrays.values()), {})
    arrays["value"][:, 55:] = np.nan
    model = graph_of(OPERATOR.own, arrays, opset=17)

    one, two = (Session(model, threads=n).run(arrays)["result"] for n in (1, 2))

    assert np.allclose(one, expected, rtol=1e-4, atol=1e-4)
    assert np.array_equal(one, two)


def raw_call(scores: int = 16, spread: float = 9) -> dict[str, Any]:
    """Draw 3 cameras of 2 levels, and more heads than the kernel's tables hold."""
    random = np.random.default_rng(6)
    shown = random.uniform(size=(1, 90, 1, 3, 1)) < 0.4
    drawn = {
        "value": random.normal(size=(1, 36, 23, 8)),
        "spatial_shapes": np.array([[2, 3], [3, 2]] * 3),
        "level_start_index": np.arange(6) * 6,
        "reference_points": random.uniform(-0.1, 1.1, (1, 90, 1, 3, 4, 2)),
        "sampling_offsets": random.normal(size=(1, 90, 23, 2, 8, 2)) * 0.2,
        "attention_scores": random.normal(300, spread, (1, 90, 23, 1, scores)),
        "mask": np.where(shown, random.uniform(size=shown.shape), 0),
    }
    return in_float32(drawn)


@pytest.mark.parametrize(("scores", "spread"), [(16, 9), (8, 9), (4, 90), (6, 90)])
def test_a_camera_without_weight_is_not_read(scores: int, spread: float) -> None:
    arrays = raw_call(scores, spread)
    arrays["mask"][:, :, :, 1] = 0
    expected = dialect_reference(OPERATOR, RAW, DrawnCall(arrays))
    arrays["value"][:, 12:24] = np.nan
    model = graph_of(RAW, arrays, opset=17)
    _, needed = runnable.replace_fused(model, compiled=True)
    assert [each.op_type for each in needed] == ["RawDeformableAttention"]

    one, two = (Session(model, threads=n).run(arrays)["result"] for n in (1, 2))

    assert np.allclose(one, expected, rtol=1e-4, atol=1e-5)
    assert np.array_equal(one, two)


STORED_RAW = """
<ir_version: 9, opset_import: ["" : 17, "me2e" : 1]>
call (uint8[1,36,23,8] value, int64[6,2] sizes, int64[6] starts,
      float[1,90,1,3,4,2] near, float[1,90,23,2,8,2] away, float[1,90,23,1,16] scores,
      float[1,90,1,3,1] mask) => (float[1,90,23,8] y)
<float scale = {0.02}, uint8 zero = {119}> {
    real = DequantizeLinear(value, scale, zero)
    y = me2e.RawDeformableAttention(real, sizes, starts, near, away, scores, mask)
}
"""


def test_int8_values_with_raw_offsets_and_scores() -> None:
    arrays = raw_call()
    stored = np.random.default_rng(2).integers(0, 256, (1, 36, 23, 8)).astype(np.uint8)
    model = ir.from_onnx_text(STORED_RAW)
    _, needed = runnable.replace_fused(model, compiled=True)
    assert [each.op_type for each in needed] == ["RawDeformableAttentionUint8"]

    names = [str(port.name) for port in model.graph.inputs]
    feeds = dict(zip(names, [stored, *list(arrays.values())[1:]], strict=True))
    result = Session(model, threads=1).run(feeds)["y"]

    real = (stored.astype(np.float64) - 119) * 0.02
    expected = dialect_reference(OPERATOR, RAW, DrawnCall({**arrays, "value": real}))
    assert np.allclose(result, expected, rtol=1e-4, atol=1e-4)


STORED = """
<ir_version: 9, opset_import: ["" : 17, "trt.plugins" : 1]>
call (TYPE[2,63,24] stored, int32[2,2] sizes, int32[2] starts,
      float[2,50,3,2,4,2] at, float[2,50,3,2,4] w, float[24] by_channel)
    => (float[2,50,3,8] y)
<float one = {0.02}, TYPE zero = {ZERO}, int64[4] parted = {0, 0, 3, 8}> {
    MADE
    value = Reshape(real, parted)
    y = MultiscaleDeformableAttnPlugin_TRT(value, sizes, starts, at, w)
}
"""


@pytest.mark.parametrize(
    ("kind", "made"),
    [
        ("uint8", "real = DequantizeLinear(stored, one, zero)"),
        ("int8", "real = DequantizeLinear(stored, one, zero)"),
        ("int8", "real = DequantizeLinear<axis=2>(stored, by_channel)"),
        ("int8", "c = Cast<to=1>(stored) real = Mul(c, by_channel)"),
    ],
)
def test_int8_values_are_read_as_they_are(kind: str, made: str) -> None:
    zero = {"uint8": "119", "int8": "-3"}[kind]
    text = STORED.replace("TYPE", kind).replace("ZERO", zero).replace("MADE", made)
    model = ir.from_onnx_text(text)
    random = np.random.default_rng(4)
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    feeds: dict[str, Any] = {
        "stored": random.integers(low, high + 1, (2, 63, 24)).astype(kind),
        "sizes": np.array([[5, 11], [2, 4]], np.int32),
        "starts": np.array([0, 55], np.int32),
        "at": random.uniform(-0.2, 1.2, (2, 50, 3, 2, 4, 2)),
        "w": random.uniform(0, 1, (2, 50, 3, 2, 4)),
        "by_channel": random.uniform(0.01, 0.03, 24),
    }
    feeds = in_float32(feeds)
    ready, needed = runnable.replace_fused(model, compiled=True)
    assert [each.op_type for each in needed] == [
        f"MultiScaleDeformableAttention{kind.capitalize()}"
    ]
    assert not {"DequantizeLinear", "Cast"} & {node.op_type for node in ready.graph}

    result = Session(model, threads=1).run(feeds)["y"]

    stored = feeds["stored"].astype(np.float64)
    plain = "by_channel" in made
    real = stored * feeds["by_channel"] if plain else (stored - int(zero)) * 0.02
    inputs = [real.reshape(2, 63, 3, 8), *list(feeds.values())[1:5]]
    assert np.allclose(result, OPERATOR.reference(inputs, {}), rtol=1e-4, atol=1e-4)


def test_scales_that_the_kernel_does_not_know_stay_in_float() -> None:
    made = "p = Reshape(stored, parted) real = DequantizeLinear<axis=3>(p, by_head)"
    text = STORED.replace("TYPE", "int8").replace("ZERO", "0").replace("MADE", made)
    text = text.replace("float[24] by_channel", "float[8] by_head")

    _, needed = runnable.replace_fused(ir.from_onnx_text(text), compiled=True)

    assert [each.op_type for each in needed] == ["MultiScaleDeformableAttention"]
