from typing import Any

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.base.errors import PreconditionError
from me2e_compress.operators import (
    Dialect,
    dialect_of,
    expand,
    find,
    position_inputs,
    score_inputs,
    translate,
)
from me2e_compress.operators.deformable_attention import (
    DeformableAttention,
    RawAttention,
    RawOwnForm,
)
from me2e_compress.testing.check_operator import DrawnCall, dialect_reference
from tests.operators.running import body_and_reference, graph_of, in_float32, run
from tests.support.profiles import scaled

OPERATOR = DeformableAttention()
SHAPES = ["spatial_shapes", "level_start_index"]

levels = st.lists(
    st.tuples(st.integers(0, 5), st.integers(0, 6)), min_size=1, max_size=3
)
calls = st.fixed_dictionaries(
    {
        "sizes": levels,
        "batch": st.integers(1, 2),
        "queries": st.integers(1, 4),
        "heads": st.integers(1, 3),
        "width": st.integers(1, 5),
        "points": st.sampled_from([2, 4]),
        "group": st.sampled_from([1, 2]),
        "seed": st.integers(0, 1000),
    }
)
CALL: dict[str, Any] = {
    "sizes": [(3, 4), (0, 2), (2, 1)],
    "batch": 2, "queries": 3, "heads": 2, "width": 3, "points": 4, "group": 2,
    "seed": 0,
}  # fmt: skip
dialects = st.sampled_from(OPERATOR.all_dialects())


def arrays_of(dialect: Dialect, call: dict[str, Any]) -> dict[str, npt.NDArray[Any]]:
    """Draw a call; a good part of the positions lies outside of the maps."""
    random = np.random.default_rng(call["seed"])
    sizes = np.array(call["sizes"], dialect.operands[1].types[0].numpy())
    areas = sizes.astype(np.int64).prod(axis=1)
    batch, queries, heads = call["batch"], call["queries"], call["heads"]
    count, points = len(sizes), call["points"]
    value = random.normal(size=(batch, int(areas.sum()), heads, call["width"]))
    head = (batch, queries, heads)
    if isinstance(dialect, RawOwnForm):
        parts = {
            "spatial_shapes": sizes,
            "level_start_index": areas.cumsum() - areas,
            **repeating(random, head, count, points),
        }
    elif isinstance(dialect, RawAttention):
        parts = {
            "spatial_shapes": sizes,
            "reference_points": random.uniform(
                -0.1, 1.1, (batch, queries, 1, 2 * call["group"])
            ),
            "sampling_offsets": random.normal(size=(*head, count * points * 2)) * 2,
            "attention_weights": random.normal(size=(*head, count * points)),
        }
    else:
        parts = {
            "spatial_shapes": sizes,
            "level_start_index": (areas.cumsum() - areas).astype(sizes.dtype),
            "sampling_locations": random.uniform(-0.3, 1.3, (*head, count, points, 2)),
            "attention_weights": random.uniform(size=(*head, count, points)),
        }
    return in_float32({"value": value, **parts})


def repeating(
    random: np.random.Generator, head: tuple[int, int, int], levels: int, points: int
) -> dict[str, npt.NDArray[np.float64]]:
    """Draw operands of the raw own form, each of which repeats where it may."""

    def part(size: int) -> int:
        divisors = [each for each in range(1, size + 1) if size % each == 0]
        return int(random.choice(divisors))

    def small() -> list[int]:
        return [int(random.choice([1, size])) for size in head]

    row = part(levels * points)
    mask = random.normal(size=(*small(), part(levels), part(points)))
    return {
        "reference_points": random.uniform(
            -0.1, 1.1, (*small(), part(levels), part(points), 2)
        ),
        "sampling_offsets": random.normal(size=(*head, part(levels), points, 2)) * 0.2,
        "attention_scores": random.normal(
            size=(*small(), part(levels * points // row), row), scale=4
        ),
        "mask": np.where(random.uniform(size=mask.shape) < 0.5, mask, 0),
    }


@settings(max_examples=scaled(10))
@given(
    dialect=dialects, call=calls, opset=st.sampled_from([13, 17]), known=st.booleans()
)
def test_the_body_of_every_dialect_is_its_reference(
    dialect: Dialect, call: dict[str, Any], opset: int, known: bool
) -> None:
    arrays = arrays_of(dialect, call)
    constants = [name for name in SHAPES if name in arrays] if known else []
    model = graph_of(dialect, arrays, opset=opset, constants=constants)
    got, want = body_and_reference(OPERATOR, dialect, model, arrays)
    assert got.shape == want.shape
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-4)


@pytest.mark.parametrize("dialect", OPERATOR.all_dialects(), ids=lambda d: d.name)
@pytest.mark.parametrize("opset", [13, 17])
def test_sizes_that_only_the_run_tells(dialect: Dialect, opset: int) -> None:
    arrays = arrays_of(dialect, CALL)
    raw = isinstance(dialect, RawAttention)  # needs levels and points of a group
    constants = ["spatial_shapes", "reference_points"] if raw else []
    model = graph_of(dialect, arrays, opset=opset, constants=constants, open_dims=True)
    got, want = body_and_reference(OPERATOR, dialect, model, arrays)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["me2e", "autoware", "derryhub", "me2e-raw"])
def test_in_float64_the_body_is_the_reference_to_rounding(name: str) -> None:
    dialect = dialect_of(OPERATOR, name)
    assert dialect is not None
    arrays = {
        name: array.astype(np.float64) if array.dtype == np.float32 else array
        for name, array in arrays_of(dialect, CALL).items()
    }
    model = graph_of(dialect, arrays, opset=13, constants=SHAPES[:1])
    got, want = body_and_reference(OPERATOR, dialect, model, arrays)
    assert got.dtype == np.float64
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-12)


@settings(max_examples=scaled(10))
@given(call=calls, one=dialects, other=dialects)
def test_a_round_trip_through_another_dialect_gives_the_same(
    call: dict[str, Any], one: Dialect, other: Dialect
) -> None:
    if isinstance(other, RawAttention) and not isinstance(one, RawAttention):
        one = dialect_of(OPERATOR, "derryhub") or one  # its weights must be raw
    if isinstance(one, RawAttention) and isinstance(other, RawOwnForm):
        other = OPERATOR.own  # its weights would come back as a mask
    arrays = arrays_of(one, call)
    constants = [name for name in SHAPES if name in arrays]
    model = graph_of(one, arrays, opset=17, constants=constants)
    want = dialect_reference(OPERATOR, one, DrawnCall(arrays))
    for to in (other, one):
        node = next(each for each in model.graph if find(each))
        translate(node, to, opset=17, by="test")
        made = next(each for each in model.graph if find(each))
        assert find(made) == (OPERATOR, to)
        to.check(made)
    assert made.op_type == one.op_type
    expand(made, opset=17, by="test")
    model.graph.opset_imports.clear()
    model.graph.opset_imports[""] = 17
    np.testing.assert_allclose(run(model, arrays), want, rtol=0, atol=1e-4)


def node_of(dialect: str, **changed: npt.NDArray[Any]) -> ir.Node:
    row = dialect_of(OPERATOR, dialect)
    assert row is not None
    call = {**CALL, "sizes": [(2, 3), (1, 2)], "batch": 1, "points": 2, "group": 1}
    arrays = arrays_of(row, call)
    return graph_of(row, {**arrays, **changed}, opset=17, constants=SHAPES[:1]).graph[0]


@pytest.mark.parametrize(
    ("dialect", "attribute", "arrays", "message"),
    [
        ("mmdeploy", ir.AttrInt64("im2col", 64), {}, "'im2col'; there are im2col_step"),
        ("mmdeploy", ir.AttrString("im2col_step", "64"), {}, "step is '64', not int"),
        (
            "tensorrt",
            None,
            {"sampling_locations": np.zeros((1, 3, 2, 8), np.float32)},
            r"fused: MultiscaleDeformableAttnPlugin_TRT of TensorRT OSS:"
            r" sampling_locations is \[1, 3, 2, 8\], not \[N=1, Q=3, M=2, L=2",
        ),
        ("derryhub", None, {"spatial_shapes": np.ones((3, 2), "i")}, "with 3 levels"),
        ("me2e-raw", None, {"mask": np.ones((1,) * 4 + (3,), "f")}, "3 of axis 4, whi"),
    ],
)
def test_what_a_dialect_does_not_take_is_named(
    dialect: str,
    attribute: ir.Attr | None,
    arrays: dict[str, npt.NDArray[Any]],
    message: str,
) -> None:
    node = node_of(dialect, **arrays)
    if attribute is not None:
        node.attributes.add(attribute)
    with pytest.raises(PreconditionError, match=message):
        expand(node, opset=17, by="test")


def test_weights_of_no_softmax_have_no_raw_form() -> None:
    raw = dialect_of(OPERATOR, "derryhub")
    assert raw is not None
    with pytest.raises(PreconditionError, match="before their softmax"):
        translate(node_of("tensorrt"), raw, opset=17, by="test")


@pytest.mark.parametrize(
    ("domain", "version", "name"),
    [
        ("trt", "1", "far3d"),
        ("trt.plugins", "2", "tensorrt-v2"),
        ("anything", "1", "tensorrt"),
        ("me2e.plugin", "1", "tensorrt"),
        (None, "", "dl4agx-uniad"),  # the type of the sizes tells the patched library
    ],
)
def test_the_domain_and_the_version_tell_the_dialect(
    domain: str | None, version: str, name: str
) -> None:
    node = node_of("derryhub", spatial_shapes=np.array([[2, 3], [1, 2]]))
    if domain is not None:
        node = node_of("tensorrt")
        node.domain = domain
        node.attributes["plugin_version"] = ir.AttrString("plugin_version", version)
    result = find(node)
    assert result is not None
    assert result[1].name == name
    assert find(ir.node("GridSample", [])) is None


def test_it_says_which_inputs_are_positions_and_which_scores() -> None:
    raw, own = "MultiScaleDeformableAttnTRT", OPERATOR.own.op_type
    assert (position_inputs()[raw], score_inputs()[raw]) == ((2, 3), 4)
    assert (position_inputs()[own], score_inputs().get(own)) == ((3,), None)
