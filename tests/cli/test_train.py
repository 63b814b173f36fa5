"""``me2e-compress train``: what it refuses, and what it needs."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from me2e_compress.cli.app import build_app
from me2e_compress.errors import MissingExtraError
from me2e_compress.training.course import claim
from me2e_compress.training.curriculum import FULL
from tests.cli.conftest import Command

Capture = pytest.CaptureFixture[str]


def test_a_folder_of_another_course(
    command: Command, tmp_path: Path, capsys: Capture
) -> None:
    claim(tmp_path, FULL.on(4))

    assert command("train", "highway", "--small", "-o", tmp_path) == 1
    words = "holds another course: its config.anchors is 64, this one's 16;"
    assert words in (said := capsys.readouterr().err)
    assert said.count("\n") == 1


def test_a_folder_of_something_else(
    command: Command, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "notes.txt").write_text("mine")

    assert command("train", "highway", "--small", "-o", tmp_path) == 1
    assert "not empty, and holds no course.json" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]


def test_a_file_in_the_place_of_the_folder(
    command: Command, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "out").write_text("mine")

    assert command("train", "highway", "--small", "-o", tmp_path / "out") == 1
    assert "out is a file: name a folder" in capsys.readouterr().err


@pytest.mark.parametrize("words", [("uniad",), ("highway", "--workers", "0"), ()])
def test_words_that_make_no_sense(
    command: Command, tmp_path: Path, words: tuple[str, ...]
) -> None:
    assert command("train", *words, "-o", tmp_path / "out") == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("missing", ["torch", "highway_env", "cv2"])
def test_without_an_extra_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == missing else object()
    )

    found = CliRunner().invoke(
        build_app(), ["train", "highway", "--small", "-o", "out"]
    )

    assert isinstance(found.exception, MissingExtraError)
    assert str(found.exception).endswith("pip install 'me2e-compress[zoo,highway]'")
