"""Modelled energy is MACs and bytes times published figures, int8 where both are."""

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.modelled import (
    PROCESSES,
    ModelledEnergy,
    modelled_energy,
)

HEAD = '<ir_version: 9, opset_import: ["" : 17]>\n'
SCALES = "float s = {0.1}, int8 z = {0}"
ONES, FLOAT_ONES = ", ".join(["1"] * 16), ", ".join(["1.0"] * 16)
FLOAT = f"""m (float[4,8] x) => (float[4,2] y) <float[8,2] w = {{{FLOAT_ONES}}}> {{
    y = MatMul(x, w) }}"""
WEIGHT = f"int8[8,2] w = {{{ONES}}}"
INT8 = f"""m (float[4,8] x) => (float[4,2] y) <{SCALES}, {WEIGHT}> {{
    q = QuantizeLinear(x, s, z)
    a = DequantizeLinear(q, s, z)
    b = DequantizeLinear(w, s, z)
    y = MatMul(a, b) }}"""
WEIGHT_ONLY = f"""m (float[4,8] x) => (float[4,2] y) <{SCALES}, {WEIGHT}> {{
    b = DequantizeLinear(w, s, z)
    y = MatMul(x, b) }}"""
TRANSPOSED = f"""m (float[4,8] x) => (float[4,2] y) <{SCALES}, {WEIGHT}> {{
    q = QuantizeLinear(x, s, z)
    a = DequantizeLinear(q, s, z)
    c = Reshape(a, n)
    b = DequantizeLinear(w, s, z)
    y = MatMul(c, b) }}""".replace("z = {0}", "z = {0}, int64[2] n = {4, 8}")
IN_FLOAT = INT8.replace(WEIGHT, f"float[8,2] v = {{{FLOAT_ONES}}}").replace(
    "b = D", "w = QuantizeLinear(v, s, z)\n b = D"
)
INTEGER = f"""m (int8[4,8] x) => (int32[4,2] y) <{WEIGHT}> {{
    y = MatMulInteger(x, w) }}"""
QLINEAR = f"""m (int8[4,8] x) => (int8[4,2] y) <{SCALES}, {WEIGHT}> {{
    y = QLinearMatMul(x, s, z, w, s, z, s, z) }}"""
HALF = """m (float16[4,8] x, float16[8,2] w) => (float16[4,2] y) {
    y = MatMul(x, w) }"""


def modelled(text: str, process: str = "45nm") -> ModelledEnergy:
    model = ir.from_onnx_text(HEAD + text)
    graph.infer_shapes(model)
    return modelled_energy(model, process)


def test_a_product_by_hand() -> None:
    found = modelled(FLOAT)

    assert found.macs == {"float32": 4 * 8 * 2}
    assert found.weight_bytes == 8 * 2 * 4
    assert found.activation_bytes == (4 * 8 + 4 * 2) * 4
    assert found.mac_j == pytest.approx(64 * 4.6e-12)
    assert found.memory_j == pytest.approx((64 + 160) * 162.5e-12)
    assert found.modelled_j_per_frame == pytest.approx(found.mac_j + found.memory_j)


@pytest.mark.parametrize(
    ("text", "number", "weights", "activations"),
    [
        (INT8, "int8", 16, 32 + 32),
        (TRANSPOSED, "int8", 16, 32 + 32),
        (IN_FLOAT, "int8", 16, 32 + 32),
        (WEIGHT_ONLY, "float32", 16, 128 + 32),
        (INTEGER, "int8", 16, 32 + 32),
        (HALF, "float16", 0, 64 + 32 + 16),
    ],
)
def test_what_is_multiplied_and_moved(
    text: str, number: str, weights: int, activations: int
) -> None:
    found = modelled(text)

    assert found.macs == {number: 64}
    assert (found.weight_bytes, found.activation_bytes) == (weights, activations)


def test_integer_operators_with_scales_are_int8() -> None:
    assert modelled(QLINEAR).macs == {"int8": 64}


def test_what_is_quantized_at_once_is_written_as_integers() -> None:
    text = INT8.replace("float[4,2] y", "int8[4,2] o").replace("}}", "}").rstrip(" }")

    found = modelled(text + " o = QuantizeLinear(y, s, z) }")
    assert found.activation_bytes == 32 + 8


def test_a_weight_is_read_once() -> None:
    text = FLOAT.replace("(float[4,2] y)", "(float[4,2] y, float[4,2] u)")
    twice = modelled(text.replace("y = M", "u = MatMul(x, w) y = M"))

    assert twice.weight_bytes == modelled(FLOAT).weight_bytes
    assert twice.mac_j == pytest.approx(2 * modelled(FLOAT).mac_j)


def test_what_is_open_is_not_counted_and_said() -> None:
    found = modelled(FLOAT.replace("4", "N"))

    assert (found.modelled_j_per_frame, found.unknown_nodes) == (None, 1)
    assert "nodes not counted: 1" in found.headline


def test_nothing_to_multiply_takes_nothing() -> None:
    found = modelled("m (float[4] x) => (float[4] y) { y = Relu(x) }")

    assert found.modelled_j_per_frame == 0


def test_int8_takes_less_everywhere() -> None:
    for process in PROCESSES:
        ours, theirs = modelled(INT8, process), modelled(FLOAT, process)
        assert ours.modelled_j_per_frame is not None
        assert theirs.modelled_j_per_frame is not None
        assert ours.modelled_j_per_frame < theirs.modelled_j_per_frame


def test_no_such_process() -> None:
    with pytest.raises(EnergyError, match="no process '3nm'; there are 45nm, 7nm"):
        modelled(FLOAT, "3nm")
