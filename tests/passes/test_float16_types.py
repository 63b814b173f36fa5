"""What becomes float16 and what stays, and where the casts between them stand."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import pytest

from me2e_compress.passes import Context
from me2e_compress.passes.convert_float16 import ConvertFloat16
from me2e_compress.testing import check_pass
from tests.nets import MODULES
from tests.passes.small import bare, casts, types_of

OPSET = '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>\n'
HALF, FLOAT = ir.DataType.FLOAT16, ir.DataType.FLOAT


def converted(
    text: str,
    weights: Mapping[str, npt.ArrayLike] | None = None,
    *,
    keep_io: bool = True,
) -> ir.Model:
    arrays = {n: np.array(each, np.float32) for n, each in (weights or {}).items()}
    step = ConvertFloat16(keep_io=keep_io)
    return check_pass(step, bare(OPSET + text, arrays)).model


def test_without_keep_io_inputs_and_outputs_are_half() -> None:
    half = converted("r (float[4] x) => (float[4] y) { y = Relu(x) }", keep_io=False)

    assert half.graph.inputs[0].dtype == half.graph.outputs[0].dtype == HALF
    assert casts(half) == 0


TYPES: dict[str, tuple[str, dict[str, str]]] = {
    "an exponential": (
        "g (float[4] x) => (float[4] y) { a = Relu(x) y = Exp(a) }",
        {"Relu": "FLOAT16", "Exp": "FLOAT"},
    ),
    "a long softmax": (
        "g (float[4,2000] x) => (float[4,2000] y) { a = Relu(x) y = Softmax(a) }",
        {"Relu": "FLOAT16", "Softmax": "FLOAT"},
    ),
    "a short softmax": (
        "g (float[4,1024] x) => (float[4,1024] y) { y = Softmax(x) }",
        {"Softmax": "FLOAT16"},
    ),
    "a mask": (
        "g (float[4] x) => (float[4] y) <float c = {-1e9}> { y = Add(x, c) }",
        {"Add": "FLOAT"},
    ),
    "an epsilon": (
        "g (float[4] x) => (float[4] y) <float c = {1e-12}> { y = Add(x, c) }",
        {"Add": "FLOAT"},
    ),
    "a default of an input": (
        "g (float[2] x, float[2] c = {-1e9, 0}) => (float[2] y) { y = Add(x, c) }",
        {"Add": "FLOAT"},
    ),
    "a plugin": (
        "g (float[4] x) => (float[4] y) { a = Relu(x) y = trt.Plugin(a) }",
        {"Relu": "FLOAT16", "Plugin": "FLOAT"},
    ),
    "a comparison": (
        "c (float[4] x, float[4] t) => (bool[4] y) { y = Greater(x, t) }",
        {"Greater": "FLOAT"},
    ),
    "positions, and what they are computed with": (
        """p (float[1,4,8,8] f, float[1,2,2,2] ref, float[1,2,2,8] q, float[8,2] w,
               float[1,4,4] lidar2img) => (float[1,4,2,2] y) <float two = {2.0}> {
            value = Relu(f)
            offset = MatMul(q, w)
            at = Add(ref, offset)
            grid = Mul(at, two)
            y = GridSample(value, grid)
        }""",
        {
            "Relu": "FLOAT16",
            **dict.fromkeys(("MatMul", "Add", "Mul", "GridSample"), "FLOAT"),
        },
    ),
    "an LSTM": (
        "r (float[5,1,6] x, float[1,32,6] w, float[1,32,8] r)"
        " => (float[5,1,1,8] y) { y = LSTM<hidden_size=8>(x, w, r) }",
        {"LSTM": "FLOAT16"},
    ),
    "a GRU": (
        "r (float[5,1,6] x, float[1,24,6] w, float[1,24,8] r)"
        " => (float[5,1,1,8] y) { y = GRU<hidden_size=8>(x, w, r) }",
        {"GRU": "FLOAT16"},
    ),
    "what is made like an input": (
        "m (float[2,2] x) => (float[2,2] y) { a = Relu(x) y = EyeLike(a) }",
        {"Relu": "FLOAT16", "EyeLike": "FLOAT"},
    ),
    "what is drawn like an input": (
        "m (float[2,2] x) => (float[2,2] y) { a = Relu(x) y = RandomNormalLike(a) }",
        {"Relu": "FLOAT16", "RandomNormalLike": "FLOAT"},
    ),
}


@pytest.mark.parametrize("case", TYPES)
def test_what_becomes_float16_and_what_stays(case: str) -> None:
    text, wanted = TYPES[case]

    half = converted(text)

    assert types_of(half) == wanted
    if case != "a plugin":
        onnx.checker.check_model(ir.to_proto(half), full_check=True)


CASTS: dict[str, tuple[str, int]] = {
    "a camera matrix reaches the projection unrounded": (
        """p (float[1,4,8,8] f, float[1,2,4] lidar2img, float[4,2] points)
            => (float[1,4,1,2] y) {
            row = Transpose<perm=[0,1,2]>(lidar2img)
            pixel = MatMul(row, points)
            shape = Constant<value = int64[4] {1, 1, 2, 2}>()
            grid = Reshape(pixel, shape)
            y = GridSample(f, grid)
        }""",
        0,
    ),
    "moves between float32": (
        "m (float[4,2] x) => (float[2,4] y) { a = Exp(x) b = Transpose(a) y = Log(b) }",
        0,
    ),
    "one for both readers, one for either output": (
        "m (float[4,4] x) => (float[4,4] y, float[4,4] z)"
        " { a = Exp(x) y = Relu(a) z = Sigmoid(a) }",
        3,
    ),
}


@pytest.mark.parametrize("case", CASTS)
def test_no_more_casts_than_needed(case: str) -> None:
    text, count = CASTS[case]

    assert casts(converted(text)) == count


def test_what_a_half_and_a_float_reader_share_is_moved_in_half() -> None:
    text = (
        "m (float[4] x, float[4] z) => (float[4] y, float[8] u)"
        " { a = Concat<axis=0>(x, z)\n u = Identity(a)\n y = Relu(a) }"
    ).replace("float[4] y", "float[8] y")
    once = converted(text)

    assert types_of(once)["Concat"] == "FLOAT16"
    assert ConvertFloat16().run(once, Context(MODULES)).changes == 0


def test_an_input_that_only_float32_reads_stays_float32() -> None:
    half = converted(
        "k (float[4] x, float[4] z) => (float[4] y, float[4] u)"
        " { y = Relu(x)\n u = Exp(z) }",
        keep_io=False,
    )

    assert [v.dtype for v in half.graph.inputs] == [HALF, FLOAT]
    assert [v.dtype for v in half.graph.outputs] == [HALF, FLOAT]


@pytest.mark.parametrize(
    "body",
    [
        "s = SplitToSequence(x)\n y = ConcatFromSequence<axis=0>(s)",
        "i = BitCast<to=6>(x)\n y = BitCast<to=1>(i)",
    ],
)
def test_what_is_no_number_of_one_type_stays(body: str) -> None:
    text = f"s (float[4] x) => (float[4] y) {{ {body} }}"
    model = bare(OPSET.replace("17", "26") + text, {})

    assert check_pass(ConvertFloat16(), model).changes == 0


def test_a_weight_that_float32_reads_too_is_stored_in_both() -> None:
    half = converted(
        """w (float[1,4,8,8] f, float[2,2,2,8] q, float[8,2] w, float[3,8] z)
            => (float[1,4,2,2] y, float[3,2] u) {
            grid = MatMul(q, w)
            y = GridSample(f, grid)
            u = MatMul(z, w)
        }""",
        {"w": np.ones((8, 2))},
    )
    stored = {v.dtype for v in half.graph.initializers.values()}

    assert stored == {HALF, FLOAT}
    assert casts(half) == 2  # z and u
