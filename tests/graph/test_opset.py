"""Graphs in an opset in which onnxruntime cannot run them."""

from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.calibration.dataset import CalibrationSet, draw_frames
from me2e_compress.graph.nodes import Array
from me2e_compress.graph.opset import read_as
from me2e_compress.graph.runtime_operators import newest_ir, newest_opset
from me2e_compress.runtime.session import Session
from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.tensorrt import TensorRT
from tests.support.frames import record


def written(folder: Path, body: str, *, opset: int = 28, version: int = 15) -> Path:
    """Write a graph on x, a number a, a condition c and integers i."""
    model = ir.from_onnx_text(
        f'<ir_version: 13, opset_import: ["" : {opset}, "trt" : 1]>\n'
        f"m (float[4,4] x, float[1,2,4,4] x4, float a, bool c, int32[4] i)"
        f" => (float[4,4] y) {{ {body} }}"
    )
    model.ir_version = version
    path = folder / "new.onnx"
    path.write_bytes(ir.to_proto(model).SerializeToString())
    return path


@pytest.mark.parametrize("body", ["y = Relu(x)", "y = trt.Rotate(x)"])
def test_unchanged_operators_are_in_the_older_opset(tmp_path: Path, body: str) -> None:
    model = graph.load(written(tmp_path, body))
    assert (model.opset_imports[""], model.ir_version) == (newest_opset(), newest_ir())
    assert read_as(model) == (
        f"IR version 15 became {newest_ir()}: onnxruntime reads no newer, opset 28"
        f" became {newest_opset()}: onnxruntime has no QuantizeLinear and no"
        " DequantizeLinear in 28"
    )
    fits = written(tmp_path, body, opset=newest_opset(), version=newest_ir())
    assert read_as(graph.load(fits)) == ""
    with pytest.raises(GraphError, match=r"opset 99: onnxruntime reads up to 2\d, and"):
        graph.load(written(tmp_path, body, opset=99))


@pytest.mark.parametrize(
    "body",
    [
        "y = Cast<to=1>(x)",
        'y = Einsum<equation="ij,jk->ik">(x, x)',
        "y = Mod<fmod=1>(x, x)",
        "r = Range<stash_type=1>(a, a, a) y = Add(x, x)",
    ],
)
def test_changed_operators_are_converted_and_run(tmp_path: Path, body: str) -> None:
    assert list(Session(written(tmp_path, body)).outputs) == ["y"]


def test_names_and_metadata_of_a_node_that_is_converted_stay(tmp_path: Path) -> None:
    path = written(tmp_path, '["/head/Cast"] y = Cast<to=1>(x)')
    proto = ir.load(path)
    proto.graph[0].metadata_props["scope"] = "head"
    path.write_bytes(ir.to_proto(proto).SerializeToString())
    node = graph.load(path).graph[0]
    assert (node.name, node.metadata_props["scope"]) == ("/head/Cast", "head")


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ('["n"] y = SwiGLU(x, x)', "SwiGLU 'n' cannot be written in 2.: No Previous"),
        ('["n"] y = Mod(x, x)', "Mod 'n' cannot be .* cannot be downgraded"),
        (
            '["n"] s = BitShift<direction="LEFT">(i, i) y = Relu(x)',
            r"BitShift 'n' cannot be .* DataType \(6\)",
        ),
    ],
)
def test_operators_that_no_older_opset_has(
    tmp_path: Path, body: str, reason: str
) -> None:
    with pytest.raises(GraphError, match=rf"new\.onnx: opset 28: .*, and {reason}"):
        graph.load(written(tmp_path, body))


BRANCHES = (
    "b = If(c) <then_branch = t () => (float u) { u = Relu(a) },"
    " else_branch = e () => (float u) { u = Neg(a) }>"
)


@pytest.mark.parametrize(
    ("body", "opset", "instead"),
    [
        ("y = Swish(x)", 26, 24),
        ("y = Swish(x)", 18, 24),
        ("y = RMSNormalization(x, x)", 18, 23),
        (f"p = GlobalLpPool(x4) y = Relu(x) {BRANCHES}", 23, 21),
        ("y = Relu(x)", 20, 20),
        ("y = HardSwish(x)", 27, 27),
    ],
)
def test_a_graph_is_written_in_the_nearest_opset_that_has_all_its_operators(
    tmp_path: Path, body: str, opset: int, instead: int
) -> None:
    model = graph.load(written(tmp_path, body, opset=opset, version=10))
    assert model.opset_imports[""] == instead
    why = f"onnxruntime has no {model.graph[0].op_type} in {opset}"
    message = f"opset {opset} became {instead}: {why}" if opset != instead else ""
    assert read_as(model) == message
    assert list(Session(model).outputs) == ["y"]


def test_operators_that_no_opset_has_together_stay(tmp_path: Path) -> None:
    pooled = "p = GlobalLpPool(x4) m = ReduceMax<keepdims=0>(p)"
    body = f"{pooled} n = RMSNormalization(x, x) y = Mul(m, n)"
    path = written(tmp_path, body, opset=23)
    model = graph.load(path)
    assert (model.opset_imports[""], read_as(model).count("opset")) == (23, 0)
    with pytest.raises(GraphError, match="no kernel for GlobalLpPool of opset 23"):
        Session(model)


def test_lint_judges_the_file_as_it_lies_on_disk(tmp_path: Path) -> None:
    model = graph.load(written(tmp_path, "y = Relu(x)"))

    for target, severity in ((OnnxRuntime(), "error"), (TensorRT(), "warning")):
        (result,) = target.lint(model)
        assert (result.severity, result.rule) == (severity, "opset")
        assert "opset 28" in result.message
    # what is written of it is in the older one
    assert not OnnxRuntime().lint(model.clone())
    older = graph.load(written(tmp_path, "y = Swish(x)", opset=18, version=10))
    (result,) = OnnxRuntime().lint(older)
    assert "onnxruntime has no Swish in opset 18" in result.message


def test_an_input_with_a_value_becomes_a_constant(tmp_path: Path) -> None:
    path = written(tmp_path, "y = Mul(x, a)", opset=17, version=8)
    two = np.array(2.0, np.float32)

    model = with_value(path, 2, two)

    assert [port.name for port in model.graph.inputs] == ["x", "x4", "c", "i"]
    assert "a held a value: no input any more, but a constant; what" in read_as(model)
    # frames that were recorded with it hold that value
    (frame,) = (dict(each.arrays) for each in draw_frames(model, seed=0, count=1))
    CalibrationSet(record(tmp_path / "2", [frame | {"a": two}])).check(model)
    other = CalibrationSet(record(tmp_path / "3", [frame | {"a": two + 1}]))
    with pytest.raises(FramesError, match="a is not the one that the graph was made"):
        other.check(model)


def with_value(path: Path, index: int, array: Array, **metadata: str) -> ir.Model:
    """Give an input of a file a value, and load that."""
    model = ir.load(path)
    port = model.graph.inputs[index]
    port.const_value = ir.tensor(array, name=port.name)
    model.graph.register_initializer(port)
    model.metadata_props.update(metadata)
    ir.save(model, path)
    return graph.load(path)


def test_a_state_that_holds_a_value_stays_an_input(tmp_path: Path) -> None:
    path = written(tmp_path, "y = Mul(x, x)", opset=17, version=8)
    state = {"me2e.recurrent": '{"x": "y"}'}

    model = with_value(path, 0, np.eye(4, dtype=np.float32), **state)

    assert [port.name for port in model.graph.inputs] == ["x", "x4", "a", "c", "i"]
    assert not model.graph.initializers
    assert model.graph.inputs[0].const_value is None
    assert read_as(model) == "state x held a value, and begins as zeros"
