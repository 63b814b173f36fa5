"""Graphs that are newer than onnxruntime."""

from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.graph.opset import NEWEST_IR, NEWEST_OPSET, lowered
from me2e_compress.runtime.session import Session


def written(folder: Path, body: str, *, opset: int = 28, version: int = 14) -> Path:
    """Write a graph on x, a number a and integers i."""
    model = ir.from_onnx_text(
        f'<ir_version: 13, opset_import: ["" : {opset}, "trt" : 1]>\n'
        f"m (float[4,4] x, float a, int32[4] i) => (float[4,4] y) {{ {body} }}"
    )
    model.ir_version = version
    path = folder / "new.onnx"
    path.write_bytes(ir.to_proto(model).SerializeToString())
    return path


@pytest.mark.parametrize("body", ["y = Relu(x)", "y = trt.Rotate(x)"])
def test_an_operator_that_did_not_change_is_written_in_the_older_opset(
    tmp_path: Path, body: str
) -> None:
    model = graph.load(written(tmp_path, body))
    assert (model.opset_imports[""], model.ir_version) == (NEWEST_OPSET, NEWEST_IR)
    assert lowered(model) == "IR version 14 became 13, opset 28 became 26"
    fits = graph.load(written(tmp_path, body, opset=26, version=13))
    assert lowered(fits) == ""
    with pytest.raises(GraphError, match="opset 99: onnxruntime reads up to 26, and"):
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
def test_an_operator_that_changed_is_converted_and_runs(
    tmp_path: Path, body: str
) -> None:
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
        ('["n"] y = SwiGLU(x, x)', "SwiGLU 'n' cannot be written in that: No Previous"),
        ('["n"] y = Mod(x, x)', "Mod 'n' cannot be .* cannot be downgraded"),
        (
            '["n"] s = BitShift<direction="LEFT">(i, i) y = Relu(x)',
            r"BitShift 'n' cannot be .* DataType \(6\)",
        ),
    ],
)
def test_what_the_older_opset_cannot_say_is_one_line(
    tmp_path: Path, body: str, reason: str
) -> None:
    with pytest.raises(GraphError, match=rf"new\.onnx: opset 28: .*26, and {reason}"):
        graph.load(written(tmp_path, body))
