"""Tools of the project: mutations of the code, files entered, files written."""

import json
from pathlib import Path

import pytest

from benchmarks.subjects import seven_nodes
from benchmarks.tools import written_files
from benchmarks.tools.masks import masked
from benchmarks.tools.written_files import differences, manifest
from tests.support.command import Cli


def compressed(cli: Cli, name: str, frames: int) -> dict[str, str]:
    """Compress the seven nodes in a new folder; give the manifest of it."""
    folder = cli.folder / name
    folder.mkdir()
    seven_nodes.write_model(folder / "m.onnx")
    seven_nodes.write_frames(folder / "frames", frames)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        options = "-r full --target tensorrt --frames frames -o o.onnx"
        cli.done(f"compress m.onnx {options}")
    return manifest(folder, Path(written_files.__file__).parents[2] / "me2e_compress")


def test_the_same_run_writes_the_same_files_and_one_more_frame_shows(cli: Cli) -> None:
    before, same, more = (
        compressed(cli, name, frames) for name, frames in (("a", 2), ("b", 2), ("c", 3))
    )
    assert differences(before, same) == []
    assert differences(before, more) == [
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

    assert written_files.main(["compare", str(before), str(before)]) == 0
    capsys.readouterr()
    assert written_files.main(["compare", str(before), str(after)]) == 1
    assert capsys.readouterr().out.splitlines() == [
        "gone     gone",
        "new      new",
        "changed  other",
        "3 of 4 files differ",
    ]


PACKAGE = Path("/somewhere/me2e_compress")
KEPT_MODEL = "out/models/full.0123456789abcdef.report.json"
VARY = [
    ("o.report.json", '"seconds": 0.25,', '"seconds": 1.5e-05,'),
    ("expert.log", '"seconds": 4.387, "a": 1', '"seconds": 12, "a": 1'),
    ("expert.log", '"memory_mb": 302.9', '"memory_mb": 98'),
    ("o.report.json", '"onnx-ir": "1.0.2"', '"onnx-ir": "1.1.0rc1"'),
    ("out/study.json", '"python": "3.11.7"', '"python": "3.13.0"'),
    ("expert/evaluation.json", '"version": "0.1.0"', '"version": "0.2.0"'),
    ("r.html", "<dt>Versions</dt><dd>onnx 1.2", "<dt>Versions</dt><dd>onnx 1.3"),
    ("out/study.json", '"machine": "Orin"', '"machine": "EPYC, 2 threads"'),
    ("r.html", "<dt>Machine</dt><dd>Orin</dd>", "<dt>Machine</dt><dd>EPYC</dd>"),
    (KEPT_MODEL, '"file": "full.0123456789abcdef.onnx"',
     '"file": "full.89abcdef01234567.onnx"'),
    ("out/study.json", f'"policy": "{PACKAGE}/shipped/weights/highway.onnx"',
     f'"policy": "{PACKAGE}/weights/highway.onnx"'),
]  # fmt: skip
"""File, and two texts of it that are the same to us."""

TELL = [
    ("o.report.json", '"seconds": 0.25', '"seconds": null'),
    ("o.report.json", '"seconds": 0.25', '"seconds":  0.25'),
    ("o.report.json", '"changes": 3', '"changes": 4'),
    ("o.report.json", '"file": "a.onnx"', '"file": "b.onnx"'),
    ("o.report.json", '"onnx": "1.0"', '"onnx": "not installed as a package"'),
    ("o.plan.json", '"version": "1"', '"version": "2"'),
    ("expert/routes/A_0.json", '"seconds": 1.0', '"seconds": 2.0'),
    ("expert.log", '"decisions": 151', '"decisions": 152'),
    ("out/study.json", '"p50": {"value": 120.0', '"p50": {"value": 121.0'),
    ("out/study.json", '"policy": "/a/highway.onnx"', '"policy": "/b/highway.onnx"'),
    ("r.html", "<dt>Seed</dt><dd>0</dd>", "<dt>Seed</dt><dd>1</dd>"),
    ("tables.md", "| float | 100.0 |", "| float | 99.9 |"),
    ("o.onnx", '"seconds": 1.0', '"seconds": 2.0'),
]
"""File, and two texts of it that differ."""


def seen(folder: Path, file: str, text: str) -> bytes:
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return masked(folder, file, PACKAGE)


@pytest.mark.parametrize(
    ("same", "file", "one", "other"),
    [*((True, *each) for each in VARY), *((False, *each) for each in TELL)],
)
def test_clock_versions_machine_and_paths_are_hidden_and_all_else_shows(
    tmp_path: Path, same: bool, file: str, one: str, other: str
) -> None:
    assert (seen(tmp_path, file, one) == seen(tmp_path, file, other)) is same
