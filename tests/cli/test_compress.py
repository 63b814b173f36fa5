import json
from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from tests.cli.conftest import Command
from tests.docs.documents import faults

ABLATE = "ablate-modules{drop=[occ]}"


def test_a_pipeline_makes_a_smaller_file_and_a_report(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = command(
        *("compress", files / "in.onnx", "--passes", ABLATE),
        *("--map", files / "map.toml", "-o", files / "out.onnx"),
    )
    assert done == 0
    left = [node.op_type for node in graph.load(files / "out.onnx").graph]
    assert "Sigmoid" not in left
    record = json.loads((files / "out.report.json").read_text())
    assert record["pipeline"] == 'import-normalize,ablate-modules{drop=["occ"]}'
    assert record["output"]["sha256"] == graph.sha256_of(files / "out.onnx")
    assert "ablate-modules" in capsys.readouterr().out


def test_the_pipeline_of_a_report_repeats_the_run(
    command: Command, files: Path
) -> None:
    first = ("--passes", ABLATE, "--map", files / "map.toml")
    command("compress", files / "in.onnx", *first, "-o", files / "a.onnx")
    text = json.loads((files / "a.report.json").read_text())["pipeline"]
    again = ("--passes", text, "--map", files / "map.toml")
    command("compress", files / "in.onnx", *again, "-o", files / "b.onnx")
    assert (files / "a.onnx").read_bytes() == (files / "b.onnx").read_bytes()


def test_the_checkpoint_is_named(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = graph.load(files / "in.onnx")
    model.metadata_props["me2e.weights"] = '{"file": "a.pth", "sha256": "ab"}'
    graph.save(model, files / "in.onnx")
    words = ("--passes", ABLATE, "--map", files / "map.toml")
    command("compress", files / "in.onnx", *words, "-o", files / "out.onnx")
    line = "weights: a.pth, sha256 ab"
    assert json.loads((files / "out.report.json").read_text())["weights"] == line
    assert line in capsys.readouterr().out


def test_a_shipped_recipe_by_name(command: Command, files: Path) -> None:
    output = ("-r", "exact", "-o", files / "out.onnx")
    assert command("compress", files / "in.onnx", *output) == 0


def test_int8_by_scheme(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--scheme", "prediction", "--frames", dense / "frames")
    output = ("--map", dense / "map.toml", "-o", dense / "out.onnx", "--json")
    assert command("compress", dense / "dense.onnx", *options, *output) == 0
    record = json.loads(capsys.readouterr().out)
    assert faults("compress", record) == []
    assert record["steps"][-1]["text"] == 'quantize-int8{scheme="prediction"}'
    weights = graph.load(dense / "out.onnx").graph.initializers.values()
    assert ir.DataType.INT8 in [value.dtype for value in weights]


def test_a_graph_of_no_known_stack_is_one_module(command: Command, files: Path) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "m (float[1,4] x) => (float[1,4] y) { a = Identity(x)\n y = Relu(a) }"
    )
    graph.save(model, files / "plain.onnx")
    output = ("-r", "exact", "-o", files / "out.onnx")
    assert command("compress", files / "plain.onnx", *output) == 0
    assert len(graph.load(files / "out.onnx").graph) == 1


def test_the_driver_that_ships_is_judged_on_its_own_frames(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its planner tosses a coin on made-up inputs: the plan would go unjudged."""
    output = ("-r", "exact", "-o", tmp_path / "out.onnx", "--json")
    assert command("compress", "highway", *output) == 0
    (check,) = json.loads(capsys.readouterr().out)["verifications"]
    assert check["inputs"] == "recorded"
    assert "plan" not in check["unsteady"]
    assert check["errors"]["plan"] < 1e-5


def test_a_module_of_the_driver_that_ships_can_be_dropped(
    command: Command, tmp_path: Path
) -> None:
    """Its graph spells defaults out, which no pass may tidy up on the way."""
    passes = ("--passes", "ablate-modules{drop=[occ], drop_outputs=true}")
    output = ("--verify-frames", 0, "-o", tmp_path / "out.onnx")
    assert command("compress", "highway", *passes, *output) == 0
