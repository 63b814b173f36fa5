"""The shipped driver by its name, wherever a model is asked for."""

import json
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.errors import GraphError
from me2e_compress.marks import IN_JSON
from me2e_compress.simulator.routes import save_routes
from me2e_compress.workflows.checks import model_path
from me2e_compress.zoo import shipped
from tests.cli.conftest import Command
from tests.evaluators.highway.drivers import EXIT, straight_on
from tests.stand_in import write_model, write_shipped


@pytest.fixture(autouse=True)
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a small driver, in the place of the package's."""
    write_shipped(tmp_path / "weights")
    monkeypatch.setattr(shipped, "WEIGHTS", tmp_path / "weights")
    return tmp_path / "weights"


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """Two frames of noise."""
    folder, random = tmp_path / "frames", np.random.default_rng(3)
    folder.mkdir()
    for index in range(2):
        np.savez(
            folder / f"{index}.npz",
            img=random.normal(size=(1, 6, 3, 16, 24)).astype(np.float32),
            lidar2img=random.normal(size=(1, 6, 4, 4)).astype(np.float32),
            can_bus=random.normal(size=18).astype(np.float32),
            command=np.array([3]),
            timestamp=np.array([0.5 * index], np.float32),
        )
    (folder / "scenes.json").write_text('{"scenes": [0]}')
    return folder


def test_a_name_is_the_shipped_file(weights: Path) -> None:
    assert model_path("highway") == weights / "highway.onnx"


def test_a_file_of_that_name_wins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_model(tmp_path / "highway", seed=1)

    assert model_path("highway") == Path("highway")


def test_neither_a_file_nor_a_name() -> None:
    with pytest.raises(GraphError, match=r"^uniad: no such file; .*ship: highway$"):
        model_path("uniad")


def test_inspect(
    command: Command, capsys: pytest.CaptureFixture[str], weights: Path
) -> None:
    assert command("inspect", "highway", "--json") == 0

    found = json.loads(capsys.readouterr().out)
    assert found["map"] == "highway"
    assert found["file_bytes"] == (weights / "highway.onnx").stat().st_size
    assert [item["module"] for item in found["modules"]] == [
        *("backbone", "neck", "bev_encoder", "track", "map", "motion", "occ"),
        "planner",
    ]


def test_compress_compare_and_profile(
    command: Command,
    frames: Path,
    weights: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    small, trace = tmp_path / "small.onnx", tmp_path / "trace.json"
    before = (weights / "highway.onnx").read_bytes()

    assert command("compress", "highway", "-r", "exact", "-o", small) == 0
    assert command("profile", "highway", frames, "-o", trace) == 0
    capsys.readouterr()
    assert command("compare", "highway", small, frames, "--json") == 0

    found = json.loads(capsys.readouterr().out)
    assert found["plan"]["max_m"] < 1e-3
    assert json.loads(trace.read_text())["samples_us"]
    assert (weights / "highway.onnx").read_bytes() == before


def test_a_module_is_taken_out(
    command: Command, frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "minus-occ.onnx"
    words = ("compress", "highway", "-r", "minus-occ", "-o", output)

    assert command(*words) == 1
    assert "fill=means needs recorded frames (--frames)" in capsys.readouterr().err
    assert not output.exists()
    assert command(*words, "--frames", frames, "--json") == 0
    notes = json.loads(capsys.readouterr().out)["steps"][2]["notes"]
    assert "output removed: occupancy" in notes
    # the other of the two is kept out, to measure on
    assert "occupancy reads as its mean over 1 frame" in notes


def test_the_shipped_file_is_not_compressed_in_place(
    command: Command, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("compress", "highway", "-r", "exact", "-o", weights / "highway.onnx")

    assert command(*words) == 1
    assert "highway.onnx is the input" in capsys.readouterr().err


def test_evaluate_drives_it(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_routes((EXIT,), tmp_path / "routes.json")
    words = ("evaluate", "highway", "--routes", tmp_path / "routes.json", "--json")

    assert command(*words, "-o", tmp_path / "results") == 0
    assert json.loads(capsys.readouterr().out)["routes"]["driven"] == 1


def test_evaluate_names_everything_that_could_drive(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("evaluate", "nobody", "-o", tmp_path / "results") == 1

    line = capsys.readouterr().err.strip()
    assert (
        "nobody: no such file; models that ship: highway; policies: expert, blind"
        in line
    )
    assert "\n" not in line


def test_export_copies_it(command: Command, weights: Path, tmp_path: Path) -> None:
    assert command("export", "highway", "-o", tmp_path / "mine.onnx") == 0

    mine = (tmp_path / "mine.onnx").read_bytes()
    assert mine == (weights / "highway.onnx").read_bytes()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--opset", "16"),
        ("--seed", "0"),
        ("--heads", "nuscenes"),
        ("--weights", "a.pth"),
    ],
)
def test_a_trained_model_leaves_nothing_to_choose(
    command: Command,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    option: str,
    value: str,
) -> None:
    output = tmp_path / "mine.onnx"

    assert command("export", "highway", "-o", output, option, value) == 1
    line = capsys.readouterr().err.strip()
    assert f"{option}" in line
    assert "cannot be chosen" in line
    assert "\n" not in line
    assert not output.exists()


@pytest.mark.parametrize("words", [("inspect",), ("evaluate", "-o", "results")])
def test_altered_weights_are_one_line(
    command: Command,
    weights: Path,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
) -> None:
    (weights / "highway.onnx").write_bytes(b"something else")

    assert command(words[0], "highway", *words[1:]) == 1
    line = capsys.readouterr().err.strip()
    assert "highway.onnx: altered or incomplete: sha256 " in line
    assert "\n" not in line


def test_no_weights_at_all(weights: Path) -> None:
    (weights / "highway.onnx").unlink()

    with pytest.raises(GraphError, match=r"highway\.onnx: cannot be read"):
        model_path("highway")


def test_frames_are_driven(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = tmp_path / "made"
    words = ("frames", "highway", "-n", "3", "--scene-length", "2", "--seed", "1")

    assert command(*words, "-o", made) == 0
    assert command("compare", "highway", "highway", made, "--json") == 0
    assert '"frames": 3' in capsys.readouterr().out
    index = json.loads((made / "scenes.json").read_text())
    about = {"scenes": [0, 2], "stack": "highway", "seed": 1, "count": 3}
    assert index == IN_JSON | about


def test_frames_of_any_driver(command: Command, tmp_path: Path) -> None:
    model = straight_on(tmp_path / "m.onnx")

    assert command("frames", model, "-n", "1", "-o", tmp_path / "made") == 0
    with np.load(tmp_path / "made" / "000000.npz") as frame:
        assert list(frame) == ["command"]


def test_frames_of_another_layout_are_refused(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Frames of a driver with other images: one line, and no model."""
    model = write_model(tmp_path / "wide.onnx", size=(16, 32))
    made, output = tmp_path / "made", tmp_path / "small.onnx"
    assert command("frames", model, "-n", "1", "-o", made) == 0
    words = ("compress", "highway", "-r", "full", "--frames", made, "-o", output)

    assert command(*words) == 1
    line = capsys.readouterr().err.strip()
    assert "000000.npz: img has shape [1, 6, 3, 16, 32], expected [1,6,3,16,24]" in line
    assert "\n" not in line
    assert not output.exists()


def test_frames_of_nothing(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("frames", "vad-huge", "-o", tmp_path / "made") == 1
    assert "no stack 'vad-huge' in the zoo" in capsys.readouterr().err


def test_frames_without_the_simulator(
    command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)

    assert command("frames", "highway", "-o", tmp_path / "made") == 1
    assert "me2e-compress[highway]" in capsys.readouterr().err
    assert not (tmp_path / "made").exists()
