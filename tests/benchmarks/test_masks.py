import hashlib
import json
from pathlib import Path

import pytest

from benchmarks.masks import MASKS, masked, masked_name

PACKAGE = Path("/somewhere/me2e_compress")

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
    (
        "out/models/full.0123456789abcdef.report.json",
        '"file": "full.0123456789abcdef.onnx"',
        '"file": "full.89abcdef01234567.onnx"',
    ),
    (
        "out/study.json",
        f'"policy": "{PACKAGE}/shipped/weights/highway.onnx"',
        f'"policy": "{PACKAGE}/weights/highway.onnx"',
    ),
]
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


@pytest.mark.parametrize(("file", "one", "other"), VARY)
def test_clock_versions_machine_and_paths_are_hidden(
    tmp_path: Path, file: str, one: str, other: str
) -> None:
    assert seen(tmp_path, file, one) == seen(tmp_path, file, other)


@pytest.mark.parametrize(("file", "one", "other"), TELL)
def test_everything_else_shows(tmp_path: Path, file: str, one: str, other: str) -> None:
    assert seen(tmp_path, file, one) != seen(tmp_path, file, other)


@pytest.mark.parametrize("mask", MASKS, ids=lambda mask: f"{mask.name} {mask.files}")
def test_a_mask_has_an_example(mask: object) -> None:
    hiding = [
        each for each in MASKS for file, one, _ in VARY if each.hide(file, one) != one
    ]
    assert mask in hiding


def route(folder: Path, version: str, fingerprint: str | None = None) -> bytes:
    """Write an evaluation and a route of it, sealed unless a fingerprint is given."""
    made_by = {"version": version, "policy": "expert"}
    seal = hashlib.sha256(json.dumps(made_by, sort_keys=True).encode()).hexdigest()
    seen(folder, "expert/evaluation.json", json.dumps(made_by))
    text = json.dumps({"fingerprint": fingerprint or seal, "episode": {}})
    return seen(folder, "expert/routes/A_0.json", text)


def test_the_seal_of_a_route_follows_the_version(tmp_path: Path) -> None:
    assert route(tmp_path, "0.1.0") == route(tmp_path, "0.2.0")


def test_a_wrong_seal_shows(tmp_path: Path) -> None:
    assert route(tmp_path, "0.1.0") != route(tmp_path, "0.1.0", "0" * 64)


def test_the_key_of_a_studys_model_is_hidden_in_its_name() -> None:
    name = "out/models/full.0123456789abcdef.report.json"
    assert masked_name(name) == "out/models/full.<key>.report.json"


def test_other_names_stay() -> None:
    name = "out/results/full.0123456789abcdef.json"
    assert masked_name(name) == name
