"""Float16, and float32 where that is needed."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import ModuleMapError, PreconditionError, ProviderError
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.manager.output_errors import relative
from me2e_compress.passes import Context
from me2e_compress.passes.convert_float16 import ConvertFloat16
from me2e_compress.passes.convert_float32 import ConvertFloat32
from me2e_compress.runtime.providers import CpuProvider
from me2e_compress.runtime.session import run_once
from me2e_compress.testing import check_pass
from tests.frames import record
from tests.nets import MODULES, conv_attention, net
from tests.passes.small import compute

OPSET = '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>\n'
HALF, FLOAT = ir.DataType.FLOAT16, ir.DataType.FLOAT


def bare(text: str, arrays: Mapping[str, npt.NDArray[np.float32]]) -> ir.Model:
    """Read a graph whose nodes have neither names nor a past."""
    model = net(text, arrays)
    for node in model.graph:
        node.metadata_props.clear()
    return model


def converted(
    text: str,
    weights: Mapping[str, npt.ArrayLike] | None = None,
    *,
    keep_io: bool = True,
) -> ir.Model:
    arrays = {n: np.array(each, np.float32) for n, each in (weights or {}).items()}
    step = ConvertFloat16(keep_io=keep_io)
    return check_pass(step, bare(OPSET + text, arrays)).model


def types_of(model: ir.Model) -> dict[str, str]:
    """Map every operator but Cast to the element type of what it reads first."""
    return {
        node.op_type: node.inputs[0].dtype.name
        for node in model.graph
        if node.op_type != "Cast"
        and node.inputs[0] is not None
        and node.inputs[0].dtype is not None
    }


def casts(model: ir.Model) -> int:
    return sum(node.op_type == "Cast" for node in model.graph)


def test_weights_are_half_and_the_interface_is_as_it_was() -> None:
    source = conv_attention()
    found = check_pass(ConvertFloat16(), source)
    initializers = found.model.graph.initializers

    assert initializers["w"].dtype == initializers["l"].dtype == HALF
    assert graph.interface(found.model) == graph.interface(source)
    assert found.notes[0] == "10 nodes in float16, 0 stay in float32"


def test_a_second_run_changes_nothing() -> None:
    once = check_pass(ConvertFloat16(), conv_attention()).model

    assert ConvertFloat16().run(once, Context(MODULES)).changes == 0


def test_the_outputs_are_near() -> None:
    source = conv_attention()
    half = check_pass(ConvertFloat16(), source).model
    drawn = np.random.default_rng(3)
    fed = {
        str(each.name): drawn.standard_normal(graph.static_shape(each)).astype("f4")
        for each in source.graph.inputs
    }

    assert 0 < relative(run_once(source, fed)["y"], run_once(half, fed)["y"]) < 3e-3


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


def test_numbers_that_the_frames_show_to_be_too_large(tmp_path: Path) -> None:
    model = bare(
        OPSET + "b (float[4] x) => (float[4] y) { a = Relu(x)\n y = Mul(a, a) }", {}
    )
    folder = record(tmp_path / "frames", [{"x": np.full(4, 300, np.float32)}])
    context = Context(ModuleMap.whole(), CalibrationSet(folder))
    found = check_pass(ConvertFloat16(), model, context)

    assert types_of(found.model) == {"Relu": "FLOAT16", "Mul": "FLOAT"}
    assert "numbers up to 9e+04 1" in found.notes[1]


def test_the_frames_run_on_the_provider(tmp_path: Path) -> None:
    model = bare(OPSET + "b (float[4] x) => (float[4] y) { y = Relu(x) }", {})
    frames = CalibrationSet(record(tmp_path / "f", [{"x": np.ones(4, np.float32)}]))
    library = tmp_path / "gone.so"
    context = Context(
        ModuleMap.whole(), frames, provider=CpuProvider(plugins=(library,))
    )

    with pytest.raises(ProviderError, match=f"plugins library {library}: no such"):
        ConvertFloat16().run(model, context)


def test_without_frames_the_report_says_what_was_not_measured() -> None:
    found = check_pass(ConvertFloat16(), conv_attention())

    assert "was not measured" in found.notes[-1]


@pytest.mark.parametrize(
    "option",
    [
        {"keep_ops": ("Conv",)},
        {"keep_modules": ("backbone",)},
        {"keep_nodes": ("/b*",)},
    ],
    ids=["ops", "modules", "nodes"],
)
def test_what_the_options_keep(option: dict[str, object]) -> None:
    step = ConvertFloat16().with_options(option)
    found = check_pass(step, conv_attention(), Context(MODULES))

    assert found.model.graph.initializers["w"].dtype == FLOAT
    assert found.model.graph.initializers["l"].dtype == HALF


def test_no_such_module() -> None:
    with pytest.raises(ModuleMapError):
        check_pass(
            ConvertFloat16(keep_modules=("wheels",)),
            conv_attention(),
            Context(MODULES),
        )


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


@pytest.mark.parametrize("keep_io", [True, False])
def test_an_input_and_its_default_are_of_one_type(*, keep_io: bool) -> None:
    half = check_pass(ConvertFloat16(keep_io=keep_io), bare(DEFAULTS, {})).model
    io = {value.name: value.dtype for value in half.graph.inputs}
    x = np.array([1, 2], FLOAT.numpy() if keep_io else HALF.numpy())

    onnx.checker.check_model(ir.to_proto(half), full_check=True)
    y, z = compute(half, {"x": x, "seen": np.array(True)})

    assert io["w"] == (FLOAT if keep_io else HALF)  # only float16 reads it
    assert io["v"] == io["u"] == FLOAT  # so do an Exp, and a body
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


def test_back_to_float32() -> None:
    source = conv_attention()
    half = check_pass(ConvertFloat16(), source).model
    back = check_pass(ConvertFloat32(), half).model

    assert Counter(n.op_type for n in back.graph) == Counter(
        n.op_type for n in source.graph
    )
    assert {v.dtype for v in back.graph.initializers.values()} <= {
        FLOAT, ir.DataType.INT64
    }  # fmt: skip
    assert ConvertFloat32().run(back, Context(MODULES)).changes == 0


def test_casts_to_other_types_stay_what_they_are() -> None:
    text = (
        "h (float16[4] x) => (int32[4] y, float16[4] z)"
        " { y = Cast<to=6>(x)\n a = Cast<to=1>(x)\n z = Cast<to=10>(a) }"
    )
    back = check_pass(ConvertFloat32(), bare(OPSET + text, {})).model
    kinds = [value.dtype for value in back.graph.outputs]

    assert kinds == [ir.DataType.INT32, HALF]


def test_float32_inside_leaves_a_half_interface() -> None:
    text = "h (float16[4] x) => (float16[4] y) { a = Relu(x)\n y = Sigmoid(a) }"
    back = check_pass(ConvertFloat32(), bare(OPSET + text, {})).model

    assert types_of(back) == {"Relu": "FLOAT", "Sigmoid": "FLOAT"}
    assert casts(back) == 2
