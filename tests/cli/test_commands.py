import json
import re
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.cli.app import COMMANDS
from tests.cli.conftest import Command, strict, write_frames
from tests.docs.documents import faults
from tests.nets import conv_attention

NAMES = sorted(COMMANDS)


@pytest.mark.parametrize("name", NAMES)
def test_every_command_explains_itself(
    command: Command, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert command(name, "--help") == 0
    assert name in capsys.readouterr().out


@pytest.mark.parametrize("name", NAMES)
def test_the_list_of_commands_says_what_the_command_says(name: str) -> None:
    full = COMMANDS[name].load().help
    assert COMMANDS[name].help == full.partition("\n")[0]


@pytest.mark.parametrize("name", NAMES)
def test_every_command_is_documented(name: str) -> None:
    root = Path(__file__).parents[2]
    page = (root / "docs" / "commands.md").read_text(encoding="utf-8")
    assert re.search(rf"^\* `me2e-compress {name}\b", page, re.MULTILINE)
    assert f"`{name}`" in (root / "README.md").read_text(encoding="utf-8")


def test_a_wrong_word_is_a_usage_error(command: Command) -> None:
    assert command("compres") == 2


def test_inspect_counts_by_module(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("inspect", files / "in.onnx", "--map", files / "map.toml", "--json")
    assert command(*words) == 0
    found = json.loads(capsys.readouterr().out)
    assert faults("inspect", found) == []
    counts = {item["module"]: item["nodes"] for item in found["modules"]}
    assert counts == {"backbone": 1, "occ": 1, "planner": 1}
    assert found["inputs"] == [{"name": "camera", "type": "FLOAT", "shape": "[1,4]"}]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('{"file": "vad.pth", "sha256": "ab", "epoch": 60}', "weights: vad.pth, epoch"),
        ('{"file": 1}', "metadata me2e.weights is malformed"),
        ("", "metadata me2e.weights is malformed"),
    ],
)
def test_inspect_names_the_checkpoint(
    command: Command,
    files: Path,
    capsys: pytest.CaptureFixture[str],
    text: str,
    line: str,
) -> None:
    model = graph.load(files / "in.onnx")
    model.metadata_props["me2e.weights"] = text
    graph.save(model, files / "in.onnx")
    assert command("inspect", files / "in.onnx", "--map", files / "map.toml") == 0
    assert line in capsys.readouterr().out


def test_inspect_for_people(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("inspect", files / "in.onnx", "--map", files / "map.toml") == 0
    assert "3 by scope" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("metadata", "said"),
    [
        (None, "fed back: memory_out as memory"),
        ('{"memory": "nowhere"}', "me2e.recurrent pairs memory with nowhere"),
    ],
)
def test_inspect_says_which_outputs_are_fed_back(
    command: Command,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    metadata: str | None,
    said: str,
) -> None:
    model = conv_attention()
    if metadata is not None:
        model.metadata_props["me2e.recurrent"] = metadata
    graph.save(model, tmp_path / "m.onnx")

    assert command("inspect", tmp_path / "m.onnx") == 0
    assert said in " ".join(capsys.readouterr().out.split())


@pytest.fixture
def plugin(files: Path) -> Path:
    """A graph in which a plugin reads a product of 2e9 MACs."""
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>\n'
        "m (float[1000,1000] camera, float[1000,2000] w) => (float[1000,2000] y)"
        ' { ["/backbone/MatMul"] a = MatMul(camera, w)'
        ' ["/plan_head/Rotate"] y = trt.Rotate(a) }'
    )
    graph.save(model, files / "plugin.onnx")
    return files / "plugin.onnx"


def test_inspect_counts_a_plugin_s_macs_as_unknown(
    command: Command, plugin: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--map", plugin.with_name("map.toml"), "--json")
    assert command("inspect", plugin, *words) == 0
    found = json.loads(capsys.readouterr().out)
    costs = {
        item["module"]: (item["macs"], item["unknown_macs_nodes"])
        for item in found["modules"]
    }
    assert costs == {
        "backbone": (2_000_000_000, 0),
        "occ": (0, 0),
        "planner": (None, 1),
    }
    assert (found["macs"], found["unknown_macs_nodes"]) == (2_000_000_000, 1)


def test_inspect_says_that_a_sum_is_a_lower_bound(
    command: Command, plugin: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("inspect", plugin, "--map", plugin.with_name("map.toml")) == 0
    assert "at least 2.000, 1 node not counted" in capsys.readouterr().out


def test_a_graph_compared_with_itself_is_equal(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (files / "in.onnx", files / "in.onnx", files / "frames", "--json")
    assert command("compare", *words) == 0
    found = strict(capsys.readouterr().out)
    assert faults("compare", found) == []
    assert [item["error"] for item in found["outputs"]] == [0.0]
    assert [item["sqnr_db"] for item in found["outputs"]] == [None]
    assert found["frames"] == 2


def test_a_reference_shows_what_the_runtime_makes_of_a_graph(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "pool (float[1,1,2,2] camera) => (float[1,1,2,2] plan)\n"
        "<int64[8] around = {0, 0, 1, 1, 0, 0, 1, 1}>\n"
        "{ q = Pad(camera, around) plan = MaxPool<kernel_shape=[3,3]>(q) }"
    )
    graph.save(model, tmp_path / "m.onnx")
    write_frames(tmp_path / "frames", camera=np.full((1, 1, 2, 2), -9, np.float32))
    words = ("compare", tmp_path / "m.onnx", tmp_path / "m.onnx", tmp_path / "frames")

    assert command(*words, "--json") == 0
    (same,) = strict(capsys.readouterr().out)["outputs"]
    assert command(*words, "--json", "--reference") == 0
    (wrong,) = strict(capsys.readouterr().out)["outputs"]

    assert (same["sqnr_db"], wrong["sqnr_db"]) == (None, None)
    assert same["error"] == 0.0
    assert wrong["error"] is None  # infinite: zeros became negative


def test_doctor_names_the_versions(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("doctor", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert faults("doctor", document) == []
    found = {item["what"]: item["found"] for item in document["checkups"]}
    assert found["onnxruntime"]
    assert found["cv2"]
