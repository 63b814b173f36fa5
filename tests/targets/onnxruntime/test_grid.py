import onnx_ir as ir
import pytest

from me2e_compress.targets.onnxruntime.region import never_negative
from tests.calls import calls


def nested(first: str, depth: int) -> ir.Value:
    """Concat a tensor with its own maximum, over and over."""
    source = ir.Value(name="x")
    value = ir.node(first, [source]).outputs[0]
    for _ in range(depth):
        pooled = ir.node("MaxPool", [value], {"kernel_shape": [1, 1]}).outputs[0]
        value = ir.node("Concat", [value, pooled], {"axis": 1}).outputs[0]
    return value


@pytest.mark.parametrize(("first", "found"), [("Relu", True), ("Neg", False)])
def test_what_many_ways_lead_to_is_looked_at_once(first: str, found: bool) -> None:
    value = nested(first, 2000)

    # one look at each way would be 2 ** 2000 calls
    assert calls(lambda: never_negative(value)) < 100 * 2000
    assert never_negative(value) is found


def test_one_negative_branch_is_enough() -> None:
    source = ir.Value(name="x")
    branches = [ir.node(op, [source]).outputs[0] for op in ("Relu", "Neg", "Sigmoid")]

    assert not never_negative(ir.node("Concat", branches, {"axis": 1}).outputs[0])
