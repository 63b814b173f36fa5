"""``inspect``: modules, costs, and what a file says of itself."""

from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.graph.runtime_operators import newest_opset
from tests.graph.test_opset import written
from tests.support.command import Cli
from tests.support.nets import conv_attention, save_text

IN = "inspect in.onnx --map map.toml"


def test_nodes_are_counted_by_module(cli: Cli, files: Path) -> None:
    found = cli.document(IN)
    counts = {item["module"]: item["nodes"] for item in found["modules"]}
    assert counts == {"backbone": 1, "occ": 1, "planner": 1}
    assert found["inputs"] == [{"name": "camera", "type": "FLOAT", "shape": "[1,4]"}]
    assert "3 by scope" in cli.done(IN).out


@pytest.mark.parametrize(
    ("metadata", "said"),
    [
        (None, "fed back: memory_out as memory"),
        ('{"memory": "nowhere"}', "me2e.recurrent pairs memory with nowhere"),
    ],
)
def test_outputs_that_are_fed_back_are_told(
    cli: Cli, tmp_path: Path, metadata: str | None, said: str
) -> None:
    model = conv_attention()
    if metadata is not None:
        model.metadata_props["me2e.recurrent"] = metadata
    graph.save(model, tmp_path / "m.onnx")

    assert said in cli.done("inspect m.onnx").words


def test_an_input_that_nothing_reads_is_told(cli: Cli, tmp_path: Path) -> None:
    text = "m (float[2] x, float[1] idle) => (float[2] y) { y = Relu(x) }"
    save_text(tmp_path / "m.onnx", text)

    assert "nothing reads input idle\n" in cli.done("inspect m.onnx").out


def test_a_plugin_s_macs_are_unknown_and_a_sum_is_a_lower_bound(
    cli: Cli, files: Path
) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>\n'
        "m (float[1000,1000] camera, float[1000,2000] w) => (float[1000,2000] y)"
        ' { ["/backbone/MatMul"] a = MatMul(camera, w)'
        ' ["/plan_head/Rotate"] y = trt.Rotate(a) }'
    )
    graph.save(model, files / "in.onnx")

    found = cli.document(IN)
    costs = {
        item["module"]: (item["macs"], item["unknown_macs_nodes"])
        for item in found["modules"]
    }
    known = {"backbone": (2_000_000_000, 0), "occ": (0, 0), "planner": (None, 1)}
    assert costs == known
    assert (found["macs"], found["unknown_macs_nodes"]) == (2_000_000_000, 1)
    assert "at least 2.000, 1 node not counted" in cli.done(IN).out


def test_open_dimensions_are_shown_with_what_they_cost_until_they_have_a_size(
    cli: Cli, tmp_path: Path
) -> None:
    save_text(
        tmp_path / "m.onnx",
        "m (float[batch,16,8,8] image, float[32,16,3,3] w, float[64,32] l)"
        " => (float[batch,64] y) <int64[2] flat = {-1, 32}>"
        " { a = Conv(image, w) p = GlobalAveragePool(a)"
        " f = Reshape(p, flat) y = Gemm<transB=1>(f, l) }",
    )

    shown = cli.done("inspect m.onnx").words
    assert "[batch,16,8,8]" in shown
    assert "2 nodes not counted: 1 Conv, 1 Gemm; --set-dim" in shown
    assert "--set-dim NAME=SIZE for batch" in shown
    found = cli.document("inspect m.onnx --set-dim batch=2")
    assert found["macs"] == 2 * 6 * 6 * 32 * 16 * 9 + 2 * 64 * 32
    assert found["inputs"][0]["shape"] == "[2,16,8,8]"


def test_a_model_newer_than_onnxruntime_says_what_was_changed(
    cli: Cli, tmp_path: Path
) -> None:
    path = written(tmp_path, "y = Relu(x)")
    model = ir.load(path)
    del model.graph.inputs[1:]
    path.write_bytes(ir.to_proto(model).SerializeToString())
    changed = f"opset 28 became {newest_opset()}: onnxruntime has no QuantizeLinear"

    assert f"opset {newest_opset()} and trt (" in cli.done("inspect", path).words
    assert changed in cli.done("inspect", path).words
    done = cli.done("compress -r exact -o small.onnx", path)
    assert changed in " ".join(done.err.split())
    assert changed in (tmp_path / "small.report.json").read_text()
