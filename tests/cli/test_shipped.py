"""The shipped driver by its name, wherever a model is asked for."""

import json
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.base.atomic import IN_JSON
from me2e_compress.base.errors import GraphError
from me2e_compress.commands.checks import model_path
from me2e_compress.shipped import drivers as shipped
from me2e_compress.simulator.routes import save_routes
from tests.evaluators.highway.drivers import EXIT, straight_on
from tests.support.command import Cli
from tests.support.stand_in import record_driver, write_model

pytestmark = pytest.mark.usefixtures("weights")


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """Two frames of noise."""
    return record_driver(tmp_path / "frames", 2)


@pytest.mark.parametrize("name", shipped.SHIPPED)
def test_a_name_is_the_shipped_file_unless_there_is_a_file_of_that_name(
    cli: Cli, weights: Path, name: str
) -> None:
    assert model_path(name) == weights / f"{name}.onnx"
    assert cli.document(f"export {name} -o mine.onnx")["output"] == "mine.onnx"
    mine = (cli.folder / "mine.onnx").read_bytes()
    assert mine == (weights / f"{name}.onnx").read_bytes()
    write_model(cli.folder / name, seed=1)
    assert model_path(name) == Path(name)
    with pytest.raises(GraphError, match=r"^uniad: no such file; .*ship: highway$"):
        model_path("uniad")


def test_inspect(cli: Cli, weights: Path) -> None:
    found = cli.document("inspect highway")

    assert found["map"] == "highway"
    assert found["file_bytes"] == (weights / "highway.onnx").stat().st_size
    assert [item["module"] for item in found["modules"]] == [
        *("backbone", "neck", "bev_encoder", "track", "map", "motion", "occ"),
        "planner",
    ]


@pytest.mark.usefixtures("frames")
def test_compress_compare_and_profile(cli: Cli, weights: Path) -> None:
    before = (weights / "highway.onnx").read_bytes()

    cli.done("compress highway -r exact -o small.onnx")
    cli.done("profile highway frames -o trace.json")
    found = cli.document("compare highway small.onnx frames")

    assert found["plan"]["max_m"] < 1e-3
    assert (weights / "highway.onnx").read_bytes() == before
    line = "compress highway -r exact -o"
    assert "highway.onnx is the input" in cli.refused(line, weights / "highway.onnx")


@pytest.mark.usefixtures("frames")
def test_a_module_is_taken_out(cli: Cli) -> None:
    line = "compress highway -r minus-occ -o minus-occ.onnx"

    assert "fill=means needs recorded frames (--frames)" in cli.refused(line)
    notes = cli.document(f"{line} --frames frames")["steps"][2]["notes"]
    assert "output removed: occupancy" in notes
    # the other of the two is kept out, to measure on
    assert "occupancy reads as its mean over 1 frame" in notes


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("name", shipped.SHIPPED)
def test_evaluate_drives_it_and_names_everything_that_could_drive(
    cli: Cli, tmp_path: Path, name: str
) -> None:
    save_routes((EXIT,), tmp_path / "routes.json")

    found = cli.document(f"evaluate {name} --routes routes.json -o results")
    assert found["routes"]["driven"] == 1
    said = cli.refused("evaluate nobody -o others")
    could = "models that ship: highway; policies: onnx, highway"
    assert f"nobody: no such file; {could}" in said


@pytest.mark.parametrize("line", ["inspect highway", "evaluate highway -o results"])
def test_altered_weights_are_one_line(cli: Cli, weights: Path, line: str) -> None:
    (weights / "highway.onnx").write_bytes(b"something else")
    said = cli.refused(line)
    assert "highway.onnx: altered or incomplete: sha256 " in said
    (weights / "highway.onnx").unlink()
    assert "highway.onnx: cannot be read" in cli.refused(line)


def test_frames_are_driven(cli: Cli, tmp_path: Path) -> None:
    cli.done("frames highway -n 3 --scene-length 2 --seed 1 -o made")

    assert cli.document("compare highway highway made")["frames"] == 3
    index = json.loads((tmp_path / "made" / "scenes.json").read_text())
    about = {"scenes": [0, 2], "stack": "highway", "seed": 1, "count": 3}
    assert index == IN_JSON | about
    straight_on(tmp_path / "m.onnx")
    cli.done("frames m.onnx -n 1 -o others")  # of any driver
    with np.load(tmp_path / "others" / "000000.npz") as frame:
        assert list(frame) == ["command"]


def test_frames_of_another_layout_are_refused(cli: Cli, tmp_path: Path) -> None:
    """Frames of a driver with other images: one line, and no model."""
    write_model(tmp_path / "wide.onnx", size=(16, 32))
    cli.done("frames wide.onnx -n 1 -o made")

    said = cli.refused("compress highway -r full --frames made -o small.onnx")

    assert "000000.npz: img has shape [1, 6, 3, 16, 32], expected [1,6,3,16,24]" in said
