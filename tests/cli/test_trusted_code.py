"""A study of somebody else runs no code of its own unless the user says so."""

from pathlib import Path

import pytest

from me2e_compress.errors import StudyError
from me2e_compress.study import load_study
from tests.cli.conftest import Command

STUDY = """
title = "Look"
baseline = "theirs"
routes = 1
{}

[[variant]]
name = "theirs"
policy = "{}"

[[condition]]
name = "ideal"
latency = "none"
"""
TRAP = """
from pathlib import Path
Path(__file__).with_suffix(".sprung").touch()
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, which came with a study."""
    (tmp_path / "their_code.py").write_text(TRAP)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("plugins", "policy"),
    [
        ("", "their_code:make"),
        ("", "python{factory=their_code:make}"),
        ('plugins = ["their.so"]', "blind"),
    ],
)
def test_a_study_that_names_code_is_refused(
    command: Command,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    plugins: str,
    policy: str,
) -> None:
    (folder / "study.toml").write_text(STUDY.format(plugins, policy))

    assert command("study", "study.toml", "-o", "out") == 1

    line = capsys.readouterr().err
    assert line.startswith("me2e-compress: study.toml runs code: ")
    assert line.endswith("look at it first, then say --trust-code\n")
    assert not (folder / "their_code.sprung").exists()
    assert not (folder / "out").exists()


def test_code_that_is_trusted_is_taken_and_not_run_yet(folder: Path) -> None:
    (folder / "study.toml").write_text(STUDY.format("", "their_code:make"))

    study = load_study(folder / "study.toml", trust_code=True)

    assert study.variants[0].policy == "their_code:make"
    assert not (folder / "their_code.sprung").exists()


def test_libraries_of_the_command_line_need_no_trust(folder: Path) -> None:
    (folder / "study.toml").write_text(STUDY.format("", "blind"))
    (folder / "mine.so").touch()
    assert load_study(folder / "study.toml", plugins=[folder / "mine.so"])


def test_a_study_that_names_no_code_needs_no_trust(folder: Path) -> None:
    (folder / "study.toml").write_text(STUDY.format("plugins = []", "blind"))
    try:
        load_study(folder / "study.toml")
    except StudyError as error:
        pytest.fail(str(error))
