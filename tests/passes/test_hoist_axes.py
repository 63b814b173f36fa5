"""An axis that is counted from the front is another one where the rank is another."""

import onnx_ir as ir
import pytest

from tests.passes.hoisted import graph_of, hoist, integers, normal, products

REPEATED = "b = Expand(a, many)  c = Reshape(b, flat)"
ALONG_AXIS = {
    "Softmax": ("y = Softmax<axis = 1>(c)", 32),
    "LogSoftmax": ("y = LogSoftmax<axis = 1>(c)", 32),
    "LayerNormalization": ("y = LayerNormalization<axis = 1>(c, g)", 32),
    "ReduceL2": ("y = ReduceL2<axes = [1]>(c)", 1),
    "ReduceMax": ("y = ReduceMax<axes = [1]>(c)", 1),
    "ReduceMean": ("y = ReduceMean<axes = [1]>(c)", 1),
    "ReduceMin": ("y = ReduceMin<axes = [1]>(c)", 1),
    "ReduceSum": ("y = ReduceSum(c, one)", 1),
}


def of(op_type: str, model: ir.Model) -> ir.Node:
    return next(node for node in model.graph if node.op_type == op_type)


@pytest.mark.parametrize("op_type", ALONG_AXIS)
def test_rows_that_were_flattened_behind_their_repetition(op_type: str) -> None:
    call, width = ALONG_AXIS[op_type]
    text = graph_of(
        f"(float[1,5,4,32] a) => (float[400,{width}] y)", f"{REPEATED} {call}"
    )
    shapes = {"many": integers(20, 5, 4, 32), "flat": integers(400, 32)}
    given = {"g": normal(32), "one": integers(1)}
    used = {name: array for name, array in given.items() if name in call}

    model = hoist(text, **shapes, **used)

    assert of(op_type, model).outputs[0].shape == (1, 20, width)


def test_rows_that_got_an_axis_between_two_repetitions() -> None:
    body = (
        "b = Expand(a, s1)  c = Unsqueeze(b, zero)  d = Expand(c, s2)"
        " y = ReduceSum(d, three)"
    )
    text = graph_of("(float[1,1,16] a) => (float[8,20,3,1] y)", body)

    model = hoist(
        text, s1=integers(20, 3, 1), zero=integers(0), s2=integers(8, 20, 1, 1),
        three=integers(3),
    )  # fmt: skip

    assert of("ReduceSum", model).outputs[0].shape == (1, 1, 1, 1)


def test_an_axis_of_a_softmax_may_not_be_negative_before_opset_11() -> None:
    text = graph_of(
        "(float[1,5,4,32] a) => (float[400,32] y)",
        f"{REPEATED} y = Softmax<axis = 1>(c)",
        version=10,
    )

    model = hoist(text, many=integers(20, 5, 4, 32), flat=integers(400, 32))

    assert of("Softmax", model).attributes.get_int("axis") == 2


@pytest.mark.parametrize("version", [11, 12, 13, 17])
@pytest.mark.parametrize("operator", ["Softmax", "LogSoftmax"])
def test_the_default_axis_of_a_softmax_is_the_second_before_opset_13(
    operator: str, version: int
) -> None:
    text = graph_of(
        "(float[1,4,32] a) => (float[20,4,32] y)",
        f"b = Expand(a, many)  y = {operator}(b)",
        version,
    )

    model = hoist(text, many=integers(20, 4, 32))

    rows = 1 if version >= 13 else 20
    assert of(operator, model).outputs[0].shape == (rows, 4, 32)


@pytest.mark.parametrize(("scale", "rows"), [((32,), 1), ((6, 32), 6)])
def test_a_scale_for_every_row_is_not_moved_with_one_row(
    scale: tuple[int, ...], rows: int
) -> None:
    text = graph_of(
        "(float[20,1,32] a) => (float[20,6,32] y)",
        "b = Expand(a, many)  y = LayerNormalization<axis = -1>(b, g)",
    )

    model = hoist(text, many=integers(20, 6, 32), g=normal(*scale))

    assert of("LayerNormalization", model).outputs[0].shape == (20, rows, 32)


@pytest.mark.parametrize("attributes", ["alpha = 0.5", "beta = 3.0", "transB = 1"])
def test_a_gemm_of_repeated_rows_keeps_its_attributes(attributes: str) -> None:
    text = graph_of(
        "(float[1,5,4,32] a) => (float[400,32] y)",
        f"{REPEATED} y = Gemm<{attributes}>(c, w, v)",
    )

    model = hoist(
        text, many=integers(20, 5, 4, 32), flat=integers(400, 32),
        w=normal(32, 32), v=normal(32),
    )  # fmt: skip

    assert products(model) == 5 * 4 * 32 * 32
