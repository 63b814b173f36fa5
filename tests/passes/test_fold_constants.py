from typing import Any

import ml_dtypes
import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.passes.fold_constants import FoldConstants
from tests.passes.small import apply, compute, ops, preserved, read

SHAPE_CHAIN = """
g (float[2,3,4] x) => (float[2,12] y) {
    shape = Shape(x)
    first = Gather<axis = 0>(shape, zero)
    row = Unsqueeze(first, axes)
    target = Concat<axis = 0>(row, rest)
    y = Reshape(x, target)
}
"""
OPEN = SHAPE_CHAIN.replace("[2,3,4] x", "[N,3,4] x").replace("[2,12]", "[N,12]")
UNKNOWN = """
<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>
g (float[2,3] x) => (float[M] y) {
    mystery = trt.Plugin(x)
    size = Shape(x)
    flat = ReduceProd<keepdims = 1>(size)
    y = Reshape(mystery, flat)
}
"""
ALIKE = """
g (float[4,4] x) => (float[4,4] y) {
    one = Transpose(weight)
    two = Transpose(weight)
    a = MatMul(x, one)
    y = MatMul(a, two)
}
"""
BRANCHES = """
g (bool c, float[2] x) => (float[2] y) {
    y = If(c) <
        then_branch = t () => (float[2] a) { s = Add(w, w)  a = Add(x, s) },
        else_branch = e () => (float[2] b) { b = Identity(x) }
    >
}
"""


QUANTIZED = """
g (float[2,4] x) => (float[2,4] y)
    <float s = {0.5}, int8 low = {-127}, int8 high = {127}>
{
    q = QuantizeLinear(weight, s, low)
    bounded = Clip(q, low, high)
    d = DequantizeLinear(bounded, s, low)
    y = MatMul(x, d)
}
"""


@pytest.mark.parametrize(
    ("text", "left", "stored"),
    [
        (SHAPE_CHAIN, ["Reshape"], ["target"]),
        (OPEN, ["Shape", "Gather", "Unsqueeze", "Concat", "Reshape"], None),
        (UNKNOWN, ["Plugin", "Reshape"], ["flat"]),
        (ALIKE, ["MatMul", "MatMul"], ["one"]),
        (BRANCHES, ["If", "Add", "Identity"], None),
        (QUANTIZED, ["DequantizeLinear", "MatMul"], ["s", "low", "bounded"]),
    ],
)
def test_what_is_folded(text: str, left: list[str], stored: list[str] | None) -> None:
    weights: dict[str, Any] = {
        "zero": np.int64(0),
        "axes": [0],
        "rest": np.array([-1]),
        "weight": np.arange(16, dtype=np.float32).reshape(4, 4),
        "w": np.ones(2, np.float32),
    }
    model = read(text, **weights)
    apply(FoldConstants(), model)
    assert [node.op_type for node in model.graph.all_nodes()] == left
    initializers = model.graph.initializers
    assert stored is None or list(initializers) == stored
    if stored == ["target"]:
        assert graph.array_of(initializers["target"]).tolist() == [2, -1]  # type: ignore[union-attr]


TAKEN = """
g (float[2] x) => (float[2] y) {
    a = Relu(x)
    b = If(c) <
        then_branch = t () => (float[2] p) { inner = Neg(x)  p = Exp(inner) },
        else_branch = e () => (float[2] q) { q = Abs(x) }
    >
    y = Add(a, b)
}
"""


@pytest.mark.parametrize(("taken", "left"), [(True, ["Neg", "Exp"]), (False, ["Abs"])])
def test_the_branch_that_is_taken_replaces_the_if(taken: bool, left: list[str]) -> None:
    model, _ = preserved(FoldConstants(), TAKEN, c=np.bool_(taken))
    assert ops(model) == ["Relu", *left, "Add"]


PRODUCT = """
g (float[4,4] x) => (float[4,4] y) {
    product = MatMul(a, b)
    y = Add(x, product)
}
"""


@pytest.mark.parametrize(("through", "left"), [(True, 1), (False, 2)])
def test_products_of_weights(through: bool, left: int) -> None:
    ones = np.ones((4, 4), np.float32)
    model = read(PRODUCT, a=ones, b=ones)
    apply(FoldConstants(through_compute=through), model)
    assert len(model.graph) == left


def test_a_constant_output_is_handed_on_by_an_identity() -> None:
    text = """
    g (float[2] x) => (float[2] y, float[2] z) {
        y = Add(a, a)
        z = Relu(x)
    }
    """
    model = read(text, a=np.ones(2, np.float32))
    apply(FoldConstants(), model)
    assert ops(model) == ["Identity", "Relu"]
    y, _ = compute(model, {"x": np.zeros(2, np.float32)})
    assert y.tolist() == [2, 2]


@pytest.mark.parametrize(
    "call",
    [
        "RandomNormalLike<seed = 1.0>(a)",
        "Bernoulli(a)",
        "Dropout(a, half, yes)",
        "DequantizeLinear(q, scale)",
    ],
)
def test_what_is_random_or_quantized_stays(call: str) -> None:
    text = f"""
    g (float[2] x) => (float[2] y) {{
        n = {call}
        y = Add(x, n)
    }}
    """
    weights: dict[str, Any] = {
        "a": np.ones(2, np.float32),
        "half": np.float32(0.5),
        "yes": np.bool_(True),
        "q": np.ones(2, np.int8),
        "scale": np.float32(0.5),
    }
    assert apply(FoldConstants(), read(text, **weights)).changes == 0


@pytest.mark.parametrize(
    "kind", [ml_dtypes.bfloat16, ml_dtypes.float8_e4m3fn, ml_dtypes.float8_e5m2]
)
def test_unusual_types_stay_whole(kind: Any) -> None:
    text = """
    <ir_version: 10, opset_import: ["" : 21]>
    g (float[2,2] x) => (float[2,2] y) {
        turned = Transpose(weight)
        wide = Cast<to = 1>(turned)
        y = Add(x, wide)
    }
    """
    weight = np.array([[1, 2], [3, 4]]).astype(kind)
    model = read(text, weight=weight)
    apply(FoldConstants(), model)
    tensor = next(iter(model.graph.initializers.values())).const_value
    assert tensor is not None
    assert tensor.dtype == ir.DataType.from_numpy(np.dtype(kind))
    assert ops(model) == ["Transpose", "Cast", "Add"]


def test_what_the_runtime_cannot_evaluate_stays_and_the_rest_folds() -> None:
    text = """
    g (int16[2000] x) => (int16[2000] y) {
        bad = Max(a, a)
        good = Add(b, b)
        sum = Add(bad, good)
        y = Add(x, sum)
    }
    """
    model = read(text, a=np.arange(2000, dtype=np.int16), b=np.ones(2000, np.int16))
    result = apply(FoldConstants(), model)
    assert "good" in model.graph.initializers
    assert any("cannot evaluate" in note for note in result.notes)
