"""Other numbers for a constant operand: in its place, beside it, or where none was."""

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.graph import array_of
from me2e_compress.graph.rewrite import Fusion, Kit, Match, fuse, op, var
from tests.passes.small import read

NEW = np.full((1, 4), 7, np.float32)


def refilled(text: str, index: int) -> ir.Model:
    """Refill an operand of the Gemm under the name ``new``, once."""
    model = read(
        f'<ir_version: 9, opset_import: ["" : 17]>\n{text}',
        w=np.ones((4, 4), np.float32),
        c=np.zeros((1, 4), np.float32),
    )
    gemm = next(node for node in model.graph if node.op_type == "Gemm")

    def refill(result: Match, kit: Kit) -> str:
        kit.refill(gemm, index, NEW, "new")
        return "once is enough"

    fuse(model, (Fusion("refill", op("Relu", var("x")), refill),), by="test")
    return model


@pytest.mark.parametrize(
    ("text", "initializers"),
    [
        ("g (float[1,4] x) => (float[1,4] y) { a = Gemm(x, w, c) y = Relu(a) }", "c w"),
        (
            "g (float[1,4] x) => (float[1,4] y, float[1,4] z)"
            " { a = Gemm(x, w, c) y = Relu(a) z = Add(x, c) }",
            "c new w",
        ),
        ("g (float[1,4] x) => (float[1,4] y) { a = Gemm(x, w) y = Relu(a) }", "new w"),
    ],
    ids=["read by it alone", "read by another too", "left out before"],
)
def test_the_operand_holds_the_new_numbers(text: str, initializers: str) -> None:
    model = refilled(text, 2)

    gemm = next(node for node in model.graph if node.op_type == "Gemm")
    stored = array_of(gemm.inputs[2])
    assert stored is not None
    np.testing.assert_array_equal(stored, NEW)
    assert sorted(model.graph.initializers) == initializers.split()
    others = [node for node in model.graph if node.op_type == "Add"]
    assert all(not np.any(array_of(node.inputs[1])) for node in others)
