"""What we write says so, in every format; what a user made does not."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest

from me2e_compress import graph
from me2e_compress.base.atomic import BYTES, MARK, is_marked, write_document
from me2e_compress.calibration.calibrator import CalibrationCheckpoint
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.recording import write_recording
from me2e_compress.fidelity.sensitivity import Int8Choice, write_recipe
from me2e_compress.runtime.frames import Frame
from me2e_compress.simulator.routes import load_routes, save_routes
from models.export import save as save_export
from tests.graph.test_files import weighted


def export(path: Path) -> None:
    """Write what the exporter of torch gives: it names itself."""
    made = onnx.helper.make_model(
        onnx.helper.make_graph([], "g", [], []),
        producer_name="pytorch",
        producer_version="2.13",
    )
    save_export(made, {"key": "value"}, path)


def record(folder: Path) -> None:
    frame = Frame(0, True, {"camera": np.zeros((1, 4), np.float32)})
    write_recording(folder, lambda _: [frame], {})


def recipe(path: Path) -> None:
    choice = Int8Choice(("head",), ("node",))
    write_recipe(path, choice, ["fold-constants"], "paper", "tensorrt")


WRITERS: dict[str, Callable[[Path], object]] = {
    "a.json": lambda path: write_document(path, {"long": "x" * 9000}),
    "m.onnx": lambda path: graph.save(weighted(), path),
    "w.onnx": lambda path: graph.save(weighted(900), path, external=True),
    "e.onnx": export,
    "r.toml": recipe,
    "c.npz": lambda path: CalibrationCheckpoint(path, {}).write(0, {}, {}),
    "frames": record,
    "routes.json": lambda path: save_routes(load_routes(), path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_all_that_is_written_says_so(tmp_path: Path, name: str) -> None:
    WRITERS[name](tmp_path / name)
    written = {each.name: is_marked(each) for each in tmp_path.iterdir()}
    assert name in written
    assert all(written.values())


def test_what_says_so_is_read_as_before(tmp_path: Path) -> None:
    record(tmp_path / "frames")
    (frame,) = CalibrationSet(tmp_path / "frames")
    assert list(frame.arrays) == ["camera"]
    save_routes(load_routes(), tmp_path / "routes.json")
    assert load_routes(tmp_path / "routes.json") == load_routes()
    graph.save(weighted(), tmp_path / "m.onnx")
    assert graph.digest(graph.load(tmp_path / "m.onnx")) == graph.digest(weighted())


def test_a_graph_that_another_program_made_of_ours_is_not_ours(tmp_path: Path) -> None:
    made = weighted()
    made.producer_name, made.producer_version = "pytorch", "2.13"
    graph.save(made, tmp_path / "m.onnx")
    assert (made.producer_name, made.producer_version) == ("pytorch", "2.13")
    model = onnx.load(tmp_path / "m.onnx")
    assert (model.producer_name, model.producer_version) == ("me2e-compress", "")
    model.producer_name = "onnx.quantize"
    onnx.save(model, tmp_path / "m.onnx")
    assert not is_marked(tmp_path / "m.onnx")


@pytest.mark.parametrize(
    "make",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(b"for me2e-compress"),
        lambda path: path.write_bytes(bytes(9000) + BYTES + bytes(9000)),
        lambda path: path.write_bytes(b"me2e-compress" * 9),
        os.mkfifo,
        lambda path: path.symlink_to("ours"),
    ],
)
def test_what_does_not_say_so_pipes_and_links_are_not_ours(
    tmp_path: Path, make: Callable[[Path], object]
) -> None:
    (tmp_path / "ours").write_text(MARK)
    make(tmp_path / "file")
    assert not is_marked(tmp_path / "file")
    assert not is_marked(tmp_path)
