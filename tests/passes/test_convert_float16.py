"""What becomes float16 and what stays, and where the casts between them stand."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import PreconditionError, ProviderError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager.verification_inputs import relative_error
from me2e_compress.passes import Context
from me2e_compress.passes.convert_float16 import ConvertFloat16
from me2e_compress.runtime.providers import CpuProvider
from me2e_compress.runtime.session import run_once
from me2e_compress.testing import check_pass
from tests.passes.small import bare, casts, compute, fed, types_of
from tests.support.frames import record
from tests.support.nets import MODULES, conv_attention, parsed, stored

OPSET = '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>\n'
HALF, FLOAT = ir.DataType.FLOAT16, ir.DataType.FLOAT


def test_weights_are_half_and_the_interface_is_as_it_was() -> None:
    source = conv_attention()
    result = check_pass(ConvertFloat16(), source)
    initializers = result.model.graph.initializers

    assert initializers["w"].dtype == initializers["l"].dtype == HALF
    assert graph.interface(result.model) == graph.interface(source)
    assert result.notes[0] == "10 nodes in float16, 0 stay in float32"
    assert "was not measured" in result.notes[-1]
    assert ConvertFloat16().run(result.model, Context(MODULES)).changes == 0
    drawn = fed(source, 3)
    wide, half = (run_once(each, drawn)["y"] for each in (source, result.model))
    assert 0 < relative_error(wide, half) < 3e-3


def test_numbers_that_the_frames_show_to_be_too_large(tmp_path: Path) -> None:
    model = bare(
        OPSET + "b (float[4] x) => (float[4] y) { a = Relu(x)\n y = Mul(a, a) }", {}
    )
    folder = record(tmp_path / "frames", [{"x": np.full(4, 300, np.float32)}])
    context = Context(ModuleMap.whole(), CalibrationSet(folder))
    result = check_pass(ConvertFloat16(), model, context)

    assert types_of(result.model) == {"Relu": "FLOAT16", "Mul": "FLOAT"}
    assert "numbers up to 9e+04 1" in result.notes[1]


@pytest.mark.parametrize(
    ("opset", "shape", "reason"),
    [(17, "n,8", "of unknown length"), (11, "4,64,32", "over more than 1024 elements")],
)
def test_a_softmax_that_stays_says_why(opset: int, shape: str, reason: str) -> None:
    text = f'<ir_version: 9, opset_import: ["" : {opset}]> g (float[{shape}] x)'
    model = parsed(text + f" => (float[{shape}] y) {{ y = Softmax(x) }}")
    graph.infer_shapes(model)
    result = ConvertFloat16().run(model, Context(ModuleMap.whole()))
    assert f"a softmax {reason} 1" in result.notes[1]


def test_the_frames_run_on_the_provider(tmp_path: Path) -> None:
    model = bare(OPSET + "b (float[4] x) => (float[4] y) { y = Relu(x) }", {})
    frames = CalibrationSet(record(tmp_path / "f", [{"x": np.ones(4, np.float32)}]))
    library = tmp_path / "gone.so"
    provider = CpuProvider(plugins=(library,))
    context = Context(ModuleMap.whole(), frames, provider=provider)

    with pytest.raises(ProviderError, match=f"plugins library {library}: no such"):
        ConvertFloat16().run(model, context)


@pytest.mark.parametrize("pattern", ["Conv", "backbone", "/b*"])
def test_what_the_option_keeps(pattern: str) -> None:
    step = ConvertFloat16(keep=(pattern,))
    result = check_pass(step, conv_attention(), Context(MODULES))

    assert result.model.graph.initializers["w"].dtype == FLOAT
    assert result.model.graph.initializers["l"].dtype == HALF


def test_what_keep_does_not_find_is_an_error() -> None:
    step = ConvertFloat16(keep=("Conv", "wheels"))
    with pytest.raises(PreconditionError, match="no node, operator or module is 'whe"):
        check_pass(step, conv_attention(), Context(MODULES))


def test_int8_takes_float16_scales_from_opset_19() -> None:
    text = """<ir_version: 9, opset_import: ["" : 17]>
    q (float[4] x) => (float[4] y) <float s = {0.1}, int8 z = {0}> {
        q = QuantizeLinear(x, s, z)
        y = DequantizeLinear(q, s, z)
    }"""
    with pytest.raises(PreconditionError, match="of opset 17: float16 scales need 19"):
        check_pass(ConvertFloat16(), bare(text, {}))
    half = check_pass(ConvertFloat16(), bare(text.replace("17", "19"), {})).model

    assert half.graph.initializers["s"].dtype == HALF
    assert casts(half) == 2


DEFAULTS = """<ir_version: 9, opset_import: ["" : 17]>
d (float[2] x, bool seen, float[2] w = {1, 2}, float[2] v = {3, 4}, float[2] u = {5, 6})
    => (float[2] y, float[2] z) {
    a = Mul(x, w)
    b = Add(a, v)
    c = Exp(v)
    z = Add(b, c)
    y = If (seen) <then_branch = t () => (float[2] t) { t = Mul(b, u) },
                   else_branch = e () => (float[2] e) { e = Neg(u) }>
}"""


def test_an_input_and_its_default_are_of_one_type() -> None:
    half = check_pass(ConvertFloat16(), bare(DEFAULTS, {})).model
    io = {value.name: value.dtype for value in half.graph.inputs}
    x = np.array([1, 2], FLOAT.numpy())

    onnx.checker.check_model(ir.to_proto(half), full_check=True)
    y, z = compute(half, {"x": x, "seen": np.array(True)})

    assert io["w"] == io["v"] == io["u"] == FLOAT
    np.testing.assert_allclose(y, [20, 48], rtol=2e-3)
    np.testing.assert_allclose(z, [4 + np.exp(3), 8 + np.exp(4)], rtol=2e-3)


def test_a_scale_stays_where_the_output_has_a_type_of_its_own() -> None:
    text = """<ir_version: 10, opset_import: ["" : 23]>
    q (float[4] x) => (float[4] y) <float s = {0.5}, int8 z = {0}> {
        q = QuantizeLinear(x, s, z)
        y = DequantizeLinear<output_dtype = 1>(q, s, z)
    }"""
    half = check_pass(ConvertFloat16(), bare(text, {})).model

    assert types_of(half)["QuantizeLinear"] == "FLOAT16"
    (y,) = compute(half, {"x": np.ones(4, np.float32)})
    np.testing.assert_array_equal(y, np.ones(4, np.float32))


FAINT = """<ir_version: 9, opset_import: ["" : 19]>
    faint (float[1,8,6,6] x, int8[32,8,3,3] w, float[32] s, int8[32] z)
        => (float[1,32,4,4] y) <float sx = {0.03125}, int8 zx = {0}> {
        q = QuantizeLinear(x, sx, zx)
        d = DequantizeLinear(q, sx, zx)
        v = DequantizeLinear<axis=0>(w, s, z)
        y = Conv<kernel_shape=[3,3]>(d, v)
    }"""


@pytest.mark.parametrize("faint", [1e-5, 3e-7, 1e-9, 1e-30])
def test_no_scale_becomes_zero_or_loses_its_digits(faint: float) -> None:
    random = np.random.default_rng(5)
    scales = random.uniform(0.002, 0.004, 32).astype(np.float32)
    scales[::4] = random.uniform(0.5, 1, 8) * faint
    integers = random.integers(-127, 128, (32, 8, 3, 3)).astype(np.int8)
    weights: dict[str, Any] = {"w": integers, "s": scales, "z": np.zeros(32, np.int8)}
    model = stored(parsed(FAINT), weights)
    graph.infer_shapes(model)
    exact = integers * scales.astype(np.float64).reshape(-1, 1, 1, 1)

    half = ConvertFloat16().run(model, Context(MODULES)).model

    (node,) = (n for n in half.graph if n.outputs[0].name == "v")
    held, steps = (
        np.asarray(graph.array_of(value), np.float64) for value in node.inputs[:2]
    )
    assert node.inputs[1] is not None
    assert node.inputs[1].dtype == HALF
    assert (steps > 0).all()
    wide = steps.reshape(-1, 1, 1, 1)
    off = np.abs(held * wide - exact) / wide
    assert off.max() <= 0.5 + 127 * 2.0**-11
    others = np.arange(32) % 4 != 0
    np.testing.assert_array_equal(held[others], integers[others])


def test_no_two_nodes_have_one_name() -> None:
    """As behind int8 for onnxruntime, whose pairs are called like Casts."""
    model = conv_attention()
    for value in model.graph.outputs:
        producer = value.producer()
        assert producer is not None
        producer.name = f"{value.name}_float"

    made = ConvertFloat16().run(model, Context(MODULES)).model

    names = [node.name for node in made.graph]
    assert len(set(names)) == len(names)


def converted(text: str, **weights: npt.NDArray[np.float32]) -> ir.Model:
    return check_pass(ConvertFloat16(), bare(OPSET + text, weights)).model


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
