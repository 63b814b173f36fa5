import json
import sys
from pathlib import Path

import pytest

from benchmarks import seven_nodes, written_files
from benchmarks.written_files import differences, manifest
from me2e_compress.cli import main

PACKAGE = Path(written_files.__file__).parents[1] / "me2e_compress"
COMPRESS = (
    "me2e-compress compress m.onnx -r full --target tensorrt --frames frames -o o.onnx"
)


def compressed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, frames: int
) -> dict[str, str]:
    """Compress the seven nodes in a new folder; give the manifest of it."""
    folder.mkdir()
    seven_nodes.write_model(folder / "m.onnx")
    seven_nodes.write_frames(folder / "frames", frames)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", COMPRESS.split())
    assert main() == 0
    return manifest(folder, PACKAGE)


def test_the_same_run_writes_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = compressed(tmp_path / "a", monkeypatch, 2)
    after = compressed(tmp_path / "b", monkeypatch, 2)

    assert differences(before, after) == []


def test_one_more_frame_shows_in_all_that_is_made_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = compressed(tmp_path / "a", monkeypatch, 2)
    after = compressed(tmp_path / "b", monkeypatch, 3)

    assert differences(before, after) == [
        "new      frames/000002.npz",
        "changed  o.onnx",
        "changed  o.report.json",
    ]


def test_compare_lists_what_differs_and_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, after = tmp_path / "a.json", tmp_path / "b.json"
    before.write_text(json.dumps({"gone": "1", "same": "2", "other": "3"}))
    after.write_text(json.dumps({"new": "1", "same": "2", "other": "4"}))

    assert written_files.main(["compare", str(before), str(after)]) == 1
    assert capsys.readouterr().out.splitlines() == [
        "gone     gone",
        "new      new",
        "changed  other",
        "3 of 4 files differ",
    ]


def test_compare_of_equal_manifests_succeeds(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"same": "1"}))

    assert written_files.main(["compare", str(path), str(path)]) == 0
