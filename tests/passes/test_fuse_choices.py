"""A choice between whole tensors: only the chosen one is read, to the bit."""

from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.passes.fuse_kernels import FuseKernels
from tests.passes.small import apply, compute, ops, read

RANDOM = np.random.default_rng(9)
ROWS, WIDE = 512, 128
SHAPE = f"float[1,{ROWS},{WIDE}]"


def model_of(body: str, *, condition: str = "bool", rows: int = ROWS) -> ir.Model:
    shape = f"float[1,{rows},{WIDE}]"
    return read(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        f"g ({condition} c, {shape} a, {shape} b) => (float[L,M,N] y) {{ {body} }}"
    )


def feeds(chosen: bool) -> dict[str, Any]:
    pair = RANDOM.normal(size=(2, 1, ROWS, WIDE)).astype(np.float32)
    pair[1, 0, 0, 0] = np.nan
    return {"c": np.array(chosen), "a": pair[0], "b": pair[1]}


STACK = "w = Where(c, a, b) y = Concat<axis = 0>(w, a)"


@pytest.mark.parametrize("chosen", [True, False])
@pytest.mark.parametrize(
    ("body", "left"),
    [
        (STACK, ["If"]),
        ("w = Where(c, a, b) y = Concat<axis = 2>(a, w)", ["If"]),
        ("w = Where(c, a, b) v = Where(c, b, a) y = Concat<axis = 1>(w, v)", ["If"]),
        ("w = Where(c, a, b) y = Neg(w)", ["If", "Neg"]),
        (
            "w = Where(c, a, b) n = Not(c) v = Where(n, b, a)"
            " y = Concat<axis = 1>(w, v)",
            ["Not", "If", "If"],
        ),
    ],
)
def test_a_choice_of_one_condition_is_a_branch(
    body: str, left: list[str], chosen: bool
) -> None:
    model, given = model_of(body), feeds(chosen)
    (want,) = compute(model, given)
    result = apply(FuseKernels(), model)
    assert result.changes >= 1
    assert [each for each in ops(model) if each != "Identity"][-len(left) :] == left
    np.testing.assert_array_equal(compute(model, given)[0], want)


QUANTIZED = (
    "s = Constant<value_float = 0.1>() z = Constant<value_ints = [0]>()"
    " k = Cast<to = 2>(z) i = Squeeze(k) q = QuantizeLinear(a, s, i)"
    " d = DequantizeLinear(q, s, i) w = Where(c, d, b) y = Neg(w)"
)


@pytest.mark.parametrize(
    ("body", "changed"),
    [
        ("w = Where(c, a, b) y = Neg(w)", {"rows": 8}),  # small
        ("w = Where(c, a, b) y = Neg(w)", {"condition": f"bool[1,{ROWS},1]"}),
        ("k = Constant<value_float = 0.5>() y = Where(c, a, k)", {}),  # broadcasts
    ],
)
def test_other_choices_stay(body: str, changed: dict[str, Any]) -> None:
    result = apply(FuseKernels(), model_of(body, **changed))
    assert (result.changes, result.notes) == (0, ())


def test_int8_stays_as_it_is() -> None:
    result = apply(FuseKernels(), model_of(QUANTIZED))
    assert result.changes == 0
    assert result.notes[0].endswith("what it chooses from is int8")
