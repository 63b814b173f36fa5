import hashlib
import json
from pathlib import Path

import pytest

from me2e_compress import graph
from me2e_compress.base.errors import GraphError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.shipped.drivers import SHIPPED, card, copy, frames_of, shipped_model


def test_an_altered_file_names_both_digests(weights: Path) -> None:
    path = weights / "highway.onnx"
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    altered = path.read_bytes()[:-1] + b"?"
    path.write_bytes(altered)

    with pytest.raises(GraphError) as caught:
        shipped_model("highway")
    message = str(caught.value)
    assert message.startswith(f"{path}: altered")
    assert hashlib.sha256(altered).hexdigest() in message
    assert card("highway").sha256 == digest
    assert digest in message
    assert "\n" not in message


@pytest.mark.parametrize("name", ["highway.onnx", "highway.json"])
def test_a_missing_file_is_named(weights: Path, name: str) -> None:
    (weights / name).unlink()

    with pytest.raises(GraphError, match=rf"/{name}: .*No such file"):
        shipped_model("highway")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sha256": "ABC"}, "sha256"),
        ({"bytes": 0}, "bytes"),
        ({"hours": "long"}, "hours"),
        ({"mood": 1}, "mood"),
        ({"data": {"seeds": [1]}}, "data.frames"),
    ],
)
def test_a_card_that_is_none(
    weights: Path, change: dict[str, object], words: str
) -> None:
    path = weights / "highway.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))

    with pytest.raises(
        GraphError, match=rf"highway\.json: not a model card: {words}: "
    ) as caught:
        card("highway")
    assert "\n" not in str(caught.value)


def test_an_unknown_name_lists_what_ships() -> None:
    with pytest.raises(GraphError, match="no model 'uniad' ships; there is highway"):
        shipped_model("uniad")


def test_a_copy_has_the_same_bytes_and_a_process_checks_once(
    weights: Path, tmp_path: Path
) -> None:
    path = shipped_model("highway")
    assert path == weights / "highway.onnx"

    target = copy("highway", tmp_path / "new" / "mine.onnx")

    assert target.read_bytes() == path.read_bytes()
    assert [each.name for each in target.parent.iterdir()] == ["mine.onnx"]
    path.write_bytes(b"altered since")
    assert shipped_model("highway") == path


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("folder", r"folder: cannot be written: Is a directory"),
        ("file/x.onnx", r"file/x\.onnx: its folder cannot be made: "),
        ("file/up/x.onnx", r"file/up/x\.onnx: its folder cannot be made: "),
    ],
)
def test_a_copy_that_cannot_be_written_is_one_line(
    weights: Path, tmp_path: Path, name: str, words: str
) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("mine")

    with pytest.raises(GraphError, match=rf"^\S+/{words}") as caught:
        copy("highway", tmp_path / name)
    assert "\n" not in str(caught.value)
    assert "Errno" not in str(caught.value)
    assert {each.name for each in tmp_path.iterdir()} == {"file", "folder", "weights"}


def test_the_shipped_file_is_not_overwritten(weights: Path) -> None:
    with pytest.raises(GraphError, match="is the shipped model"):
        copy("highway", weights / "highway.onnx")


def test_the_card_says_what_trained_it() -> None:
    root = Path(__file__).parents[1]
    told = card("highway")
    command, page = told.command.split(": ")
    kept = root / Path(page).parent / f"seed-{told.seed}/course.json"

    general = command.replace(f"--seed {told.seed}", "--seed N")
    assert general in (root / page).read_text("utf-8")
    seeds = [each["seed"] for each in json.loads(kept.read_text())["rounds"]]
    assert [*told.data.seeds] == seeds


@pytest.mark.parametrize("name", SHIPPED)
def test_a_copy_of_the_driver_has_frames_to_verify_it_on(
    tmp_path: Path, name: str
) -> None:
    copied = copy(name, tmp_path / "mine.onnx")
    other = tmp_path / "other.onnx"
    other.write_bytes(copied.read_bytes()[:-1] + b"?")

    found = frames_of(copied)

    assert found is not None
    CalibrationSet(found).check(graph.load(copied))
    assert frames_of(other) is None
