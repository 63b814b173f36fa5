"""Every dialect of every operator but deformable attention, which has its own."""

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph.shapes import infer_shapes
from me2e_compress.operators import (
    OPERATORS,
    Dialect,
    Operator,
    dialect_of,
    expand,
    find,
    operators,
    translate,
)
from me2e_compress.testing.check_operator import DrawnCall, dialect_reference
from tests.operators.drawn import DRAWS, Drawn, aggregation, attention, rotate, sampler
from tests.operators.running import body_and_reference, graph_of, run
from tests.operators.test_deformable_attention import CALL, arrays_of
from tests.support.profiles import scaled

ROWS = [
    (operator, dialect)
    for operator in operators()
    if operator.name in DRAWS
    for dialect in operator.all_dialects()
]
BACK = [row for row in ROWS if row[1].name != "sparsedrive-v2"]
"""All but one, whose int8 features come back as float."""
rows = st.sampled_from(ROWS)
seeds = st.integers(0, 10_000)


def test_maps_that_are_all_empty() -> None:
    operator = OPERATORS.build("deformable-aggregation", {})
    hold(operator, operator.own, seed=1301, opset=13, known=False)


@settings(max_examples=scaled(15))
@given(row=rows, seed=seeds, opset=st.sampled_from([13, 17, 20]), known=st.booleans())
def test_the_body_is_the_reference(
    row: tuple[Operator, Dialect], seed: int, opset: int, known: bool
) -> None:
    hold(*row, seed=seed, opset=opset, known=known)


def hold(
    operator: Operator, dialect: Dialect, *, seed: int, opset: int, known: bool
) -> None:
    arrays, attributes = DRAWS[operator.name](dialect, np.random.default_rng(seed))
    opset = max(opset, operator.opset)
    tables = [name for name in ("spatial_shape", "scale_start_index") if name in arrays]
    constants = tables if known else []
    model = graph_of(
        dialect, arrays, opset=opset, constants=constants, attributes=attributes
    )
    got, want = body_and_reference(operator, dialect, model, arrays)
    assert got.shape == want.shape
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=2e-4)


@pytest.mark.parametrize(
    ("name", "spelling", "total"),
    [
        ("deformable-attention", "autoware", 8.966951255567565),
        ("deformable-attention", "derryhub", 0.28138749866193885),
        ("deformable-attention", "me2e-raw", 0.6545682701864984),
        ("deformable-aggregation", "sparsedrive-v2", 3.9807939512435433),
        ("grid-sampler-2d", "derryhub", 2.62734635),
        ("grid-sampler-3d", "dl4agx", 9.294027669385786),
    ],
)
def test_conversions_compute_as_before(name: str, spelling: str, total: float) -> None:
    operator = OPERATORS.build(name, {})
    dialect = dialect_of(operator, spelling)
    assert dialect is not None
    drawn: Drawn = arrays_of(dialect, CALL), {}
    if name in DRAWS:
        drawn = DRAWS[name](dialect, np.random.default_rng(4))
    result = dialect_reference(operator, dialect, DrawnCall(*drawn))
    parts = np.cos(np.arange(result.size)) * result.ravel()
    assert parts.sum() == pytest.approx(total, rel=1e-7)


@pytest.mark.parametrize(
    ("operator", "dialect"), BACK, ids=lambda each: getattr(each, "name", "")
)
def test_a_round_trip_gives_the_same_node_and_the_same_numbers(
    operator: Operator, dialect: Dialect
) -> None:
    arrays, attributes = DRAWS[operator.name](dialect, np.random.default_rng(5))
    opset = max(17, operator.opset)
    model = graph_of(dialect, arrays, opset=opset, attributes=attributes)
    for to in (operator.own, dialect):
        node = next(each for each in model.graph if find(each))
        translate(node, to, opset=opset, by="test")
    (node,) = (each for each in model.graph if find(each))
    assert node.op_type == dialect.op_type
    read = dialect.attributes_of(node)
    assert read == {**read, **attributes}
    expand(node, opset=opset, by="test")
    model.graph.opset_imports.clear()
    model.graph.opset_imports[""] = opset
    want = dialect_reference(operator, dialect, DrawnCall(arrays, read))
    np.testing.assert_allclose(run(model, arrays), want, rtol=1e-4, atol=2e-4)


@pytest.mark.parametrize("padding", [0, 1, 2])
def test_bicubic_samples_are_the_reference(padding: int) -> None:
    operator = OPERATORS.build("grid-sampler-2d", {})
    arrays, given = sampler(operator.own, np.random.default_rng(2))
    attributes = {**given, "interpolation_mode": 2, "padding_mode": padding}
    model = graph_of(operator.own, arrays, opset=20, attributes=attributes)
    got, want = body_and_reference(operator, operator.own, model, arrays)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-4)


def test_heads_side_by_side_have_no_plugin() -> None:
    operator = OPERATORS.build("multi-head-attention", {})
    arrays, _ = attention(operator.dialects[0], np.random.default_rng(0))
    model = graph_of(operator.own, arrays, opset=17, attributes={"heads": 2})
    with pytest.raises(PreconditionError, match="heads in the batch, and these are 2"):
        translate(model.graph[0], operator.dialects[0], opset=17, by="test")


def test_a_value_that_an_attribute_cannot_have_is_named() -> None:
    operator = OPERATORS.build("rotate", {})
    arrays, _ = rotate(operator.own, np.random.default_rng(0))
    model = graph_of(operator.own, arrays, opset=17, attributes={"interpolation": 3})
    with pytest.raises(PreconditionError, match="interpolation is 3, not 0 or 1"):
        expand(model.graph[0], opset=17, by="test")


def test_scaled_features_give_floats_where_the_file_records_no_type() -> None:
    operator = OPERATORS.build("deformable-aggregation", {})
    dialect = dialect_of(operator, "sparsedrive-v2")
    assert dialect is not None
    arrays, _ = aggregation(dialect, np.random.default_rng(0))
    model = graph_of(dialect, arrays, opset=17)
    infer_shapes(model)
    assert model.graph.outputs[0].dtype == ir.DataType.FLOAT
