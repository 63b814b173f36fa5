"""What is known of shapes, and what an exporter's symbols must not hide."""

from pathlib import Path

import onnx
import pytest

import me2e_compress
from me2e_compress import graph
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.shapes import records_shapes, without_inferable_shapes
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context
from tests.support.nets import parsed

CHAIN = """
six (float[BATCH,6,8] x) => (float["Addy_dim_0","Addy_dim_1",8] y, float[one,48] z)
    <int64[1] minus = {-1}, int64 zero = {0}>
{
    y = Add(x, x)
    s = Shape(y)
    b = Gather(s, zero)
    r = Reshape(b, minus)
    full = Concat<axis=0>(r, minus)
    z = Reshape(y, full)
}
"""


@pytest.mark.parametrize(
    ("batch", "shape"), [("1", "[1,6,8]"), ("batch", "[Addy_dim_0,6,8]")]
)
def test_a_symbol_of_an_open_output_stays(batch: str, shape: str) -> None:
    model = parsed(CHAIN.replace("BATCH", batch))
    graph.infer_shapes(model)
    assert str(model.graph.outputs[0].shape) == shape


def test_shape_arithmetic_behind_an_output_with_a_symbol_is_folded() -> None:
    model = parsed(CHAIN.replace("BATCH", "1"))
    report = PassManager(recipe.load("exact")).run(model, Context(ModuleMap.whole()))
    assert [node.op_type for node in report.model.graph] == ["Add", "Reshape"]
    shapes = [str(value.shape) for value in report.model.graph.outputs]
    assert shapes == ["[1,6,8]", "[1,48]"]


def test_only_shapes_that_inference_gives_again_are_left_out(tmp_path: Path) -> None:
    model = parsed("""<ir_version: 9, opset_import: ["" : 17, "test": 1]>
        m (float[2,3] x) => (float[2,3] y)
            <float[2,3] w = {1, 2, 3, 4, 5, 6}, float[2,3] plugged, float[2,3] plain>
        { plain = Relu(x) plugged = test.Own(plain) y = Add(plugged, w) }
    """)
    bare = without_inferable_shapes(model)
    graph.save(bare, tmp_path / "bare.onnx")

    assert records_shapes(model)
    written = onnx.load(tmp_path / "bare.onnx")
    assert [each.name for each in written.graph.value_info] == ["plugged"]
    read = graph.load(tmp_path / "bare.onnx")
    graph.infer_shapes(read)
    assert [str(v.shape) for node in read.graph for v in node.outputs] == ["[2,3]"] * 3


@pytest.mark.parametrize("shaped", [False, True])
def test_what_is_written_records_shapes_where_its_source_did(
    shaped: bool, tmp_path: Path
) -> None:
    values = "<float[2] t>" if shaped else ""
    model = parsed(
        f"m (float[2] x) => (float[2] y) {values} {{ t = Relu(x) y = Exp(t) }}"
    )
    graph.save(model, tmp_path / "in.onnx")
    me2e_compress.compress(tmp_path / "in.onnx", tmp_path / "out.onnx", "exact")
    written = onnx.load(tmp_path / "out.onnx")
    assert bool(written.graph.value_info) == shaped
