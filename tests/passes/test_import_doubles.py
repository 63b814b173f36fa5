"""Float64 inside a graph becomes float32, but where the outside wants it."""

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import onnxruntime as ort
import pytest

from me2e_compress import graph
from tests.passes.small import normalise, settled, unstamped

Array = npt.NDArray[np.float32]


def run(model: ir.Model, **feeds: Array) -> Array:
    session = ort.InferenceSession(
        ir.to_proto(model).SerializeToString(), providers=["CPUExecutionProvider"]
    )
    return np.asarray(session.run(None, feeds)[0])


def double_grid() -> ir.Model:
    return unstamped(
        "g (float[1, 1, 4, 4] x, float[1, 3, 3, 2] p) => (float[1, 1, 3, 3] y) {"
        " wide = Cast <to: int = 11> (p)"
        " half = Constant <value: tensor = double {0.5}> ()"
        " grid = Mul (wide, half)"
        " y = GridSample (x, grid) }"
    )


def test_a_double_grid_that_onnxruntime_refuses_runs_afterwards() -> None:
    model = double_grid()
    rng = np.random.default_rng(0)
    x = rng.standard_normal((1, 1, 4, 4), np.float32)
    p = rng.uniform(-1, 1, (1, 3, 3, 2)).astype(np.float32)
    with pytest.raises(Exception, match="GridSample"):
        run(model, x=x, p=p)
    normalise(model)
    reference = unstamped(
        "g (float[1, 1, 4, 4] x, float[1, 3, 3, 2] g) => (float[1, 1, 3, 3] y) {"
        " y = GridSample (x, g) }"
    )
    np.testing.assert_allclose(
        run(model, x=x, p=p),
        run(reference, x=x, g=p / np.float32(2)),
        rtol=0,
        atol=1e-6,
    )
    assert settled(model)


def test_no_double_is_left_in_types_weights_branches_and_functions() -> None:
    model = ir.from_onnx_text(
        '<ir_version: 8, opset_import: ["": 17, "f": 1]>'
        "g (bool c, float[2] x) => (float[2] y)"
        " <double[2] w = {1.0, 2.0}, double[2] wide, double[2] z> {"
        " wide = Cast <to: int = 11> (x)"
        " z = If (c) <then_branch = t () => (double[2] a) <double k = {3.0}> {"
        " a = Mul(wide, k) },"
        " else_branch = e () => (double[2] b) { b = Add(wide, w) }>"
        " v = f.Widen(z)  y = Cast <to: int = 1> (v) }"
        '<domain: "f", opset_import: ["": 17]>'
        "Widen (i) => (o) { k = Constant <value: tensor = double {2.0}> ()"
        " w = Cast <to: int = 11> (i) o = Mul(w, k) }"
    )
    normalise(model)
    assert "DOUBLE" not in str(ir.to_proto(model))
    assert _doubles_of(ir.to_proto(model)) == 0
    x = np.array([1, 2], np.float32)
    session = ort.InferenceSession(ir.to_proto(model).SerializeToString())
    for chosen, wanted in ((True, [6, 12]), (False, [4, 8])):
        (y,) = session.run(None, {"c": np.array(chosen), "x": x})
        np.testing.assert_array_equal(y, wanted)
    assert settled(model)


def _doubles_of(message: onnx.ModelProto) -> int:
    text = str(message)
    return text.count("elem_type: 11\n") + text.count("data_type: 11\n")


def test_resize_scales_computed_in_double_become_float32() -> None:
    model = unstamped(
        "g (float[1, 1, 2, 2] x) => (float[1, 1, 4, 4] y)"
        " <double[4] factors = {1.0, 1.0, 2.0, 2.0}> {"
        " s = Identity (factors)"
        ' y = Resize <mode: string = "nearest"> (x, , s) }'
    )
    normalise(model)
    x = np.arange(4, dtype=np.float32).reshape(1, 1, 2, 2)
    np.testing.assert_array_equal(
        run(model, x=x), x.repeat(2, axis=2).repeat(2, axis=3)
    )


def test_numbers_beyond_float32_stay_finite_and_infinities_stay_infinite() -> None:
    model = unstamped(
        "g (float[3] x) => (float[3] y)"
        " <double[3] m = {-1.7976931348623157e308, 1.0, 2.0}> {"
        " w = Cast <to: int = 11> (x) s = Add(w, m) y = Cast <to: int = 1> (s) }"
    )
    lowest = np.array([-np.finfo(np.float64).max, np.inf, 2.0])
    model.graph.initializers["m"].const_value = ir.tensor(lowest, name="m")
    normalise(model)
    kept = graph.array_of(model.graph.initializers["m"])
    assert kept is not None
    np.testing.assert_array_equal(
        kept, np.array([np.finfo(np.float32).min, np.inf, 2.0], np.float32)
    )


@pytest.mark.parametrize(
    ("text", "culprit"),
    [
        ("g (double[2] x) => (float[2] y) { y = Cast<to: int = 1>(x) }", "input x"),
        ("g (float[2] x) => (double[2] y) { y = Cast<to: int = 11>(x) }", "output y"),
        (
            "g (float[2] x) => (float[2] y) <double[2] w = {1.0, 2.0}>"
            " { y = custom_op.Warp(x, w) }",
            "w of the custom operator Warp",
        ),
    ],
)
def test_doubles_that_the_outside_wants_stay(text: str, culprit: str) -> None:
    model = unstamped(text)
    result = normalise(model)
    assert _doubles_of(ir.to_proto(model)) > 0
    assert result.notes == (f"float64 stays: {culprit} is double",)
    assert settled(model)
