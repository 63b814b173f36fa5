"""``python -m models.driver.train``: what it refuses, and what it needs."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest

from me2e_compress.cli.console import print_json
from me2e_compress.metrics.scores import score
from models.driver.course import MANIFEST, RoundResult
from models.driver.curriculum import FULL
from models.driver.options import claim
from models.driver.train import main
from models.driver.workflow import TrainResult
from tests.docs.pages import ROOT
from tests.metrics.drives import drive

Capture = pytest.CaptureFixture[str]
Command = Callable[..., int]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run ``python -m models.driver.train`` with these words; give its exit code."""

    def run(*words: str | Path) -> int:
        monkeypatch.setattr(sys, "argv", ["models.driver.train", *map(str, words)])
        return main()

    return run


def test_a_folder_of_another_course(
    command: Command, tmp_path: Path, capsys: Capture
) -> None:
    claim(tmp_path / MANIFEST, "course", asdict(FULL.on(4)))

    assert command("--small", "-o", tmp_path) == 1
    words = "holds another course: its config.anchors is 64, this one's 16;"
    assert words in (said := capsys.readouterr().err)
    assert said.count("\n") == 1


def test_a_file_in_the_place_of_the_folder(
    command: Command, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "out").write_text("mine")

    assert command("--small", "-o", tmp_path / "out") == 1
    assert "out is a file: name a folder" in capsys.readouterr().err


def test_a_folder_of_a_course_that_overlooks_nobody(
    command: Command, tmp_path: Path, capsys: Capture
) -> None:
    claim(tmp_path / MANIFEST, "course", asdict(FULL.on(4)))

    assert command("--overlook", "0.3", "-o", tmp_path) == 1
    assert (
        "augmentation.no_occ is 0.2, this one's 0.0; choose" in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("words", "code"),
    [(("uniad",), 2), (("--workers", "0"), 2), (("--overlook", "1.5"), 2)],
)
def test_words_that_make_no_sense(
    command: Command, tmp_path: Path, words: tuple[str, ...], code: int
) -> None:
    assert command(*words, "-o", tmp_path / "out") == code
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("missing", ["highway_env", "cv2"])
def test_without_an_extra_it_says_what_to_install(
    command: Command,
    tmp_path: Path,
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
    missing: str,
) -> None:
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == missing else object()
    )

    assert command("--small", "-o", tmp_path / "out") == 1
    said = capsys.readouterr().err
    assert said.endswith("pip install 'me2e-compress[highway]'\n")
    assert said.count("\n") == 1


def test_what_came_of_it_is_one_document(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = RoundResult(tmp_path / "m.onnx", score((drive(),)), tmp_path / "log")

    print_json(TrainResult((made,)).document())

    (found,) = json.loads(capsys.readouterr().out)["rounds"]
    assert found["driver"] == str(tmp_path / "m.onnx")
    assert {"driver", "log", "scores"} == found.keys()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_training_that_a_signal_ends_says_nothing_of_the_interpreter(
    tmp_path: Path, number: signal.Signals
) -> None:
    words = ["-m", "models.driver.train", "-o", str(tmp_path / "course"), "--small"]
    process = subprocess.Popen(
        [sys.executable, *words, "--workers", "2"],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    time.sleep(15)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)

    assert "Traceback" not in said
    assert "Warning" not in said
    assert not list(tmp_path.rglob("*.part"))
