"""What people expect of every command: version, quiet, verbose, completion."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from me2e_compress.cli.app import COMMANDS
from me2e_compress.cli.console import EVERY_S, ProgressLines, listening
from me2e_compress.cli.verbosity import Verbosity, set_verbosity
from me2e_compress.display import duration
from me2e_compress.version import __version__
from tests.cli.conftest import Command


@pytest.fixture(autouse=True)
def _normal() -> Iterator[None]:
    yield
    set_verbosity(Verbosity.NORMAL)


def test_the_version(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    assert command("--version") == 0
    assert capsys.readouterr().out == f"me2e-compress {__version__}\n"


def test_commands_stand_in_groups(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("--help") == 0

    said = capsys.readouterr().out
    order = [entry.panel for entry in COMMANDS.values()]
    for panel in dict.fromkeys(order):
        assert f"─ {panel} ─" in said
    assert re.findall(r"^│ (\w+) +\w", said, re.MULTILINE) == list(COMMANDS)


@pytest.mark.parametrize("words", ["compress --sch", "compr"])
def test_the_shell_completes_commands_and_their_options(
    command: Command,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: str,
) -> None:
    monkeypatch.setenv("_ME2E_COMPRESS_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", f"me2e-compress {words}")
    monkeypatch.setenv("COMP_CWORD", str(len(words.split())))

    assert command() == 0

    found = "--scheme" if "--" in words else "compress"
    assert capsys.readouterr().out.split() == [found]


@pytest.mark.parametrize("words", ["-v {}", "{} --verbose"])
def test_notes_are_for_the_verbose(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str], words: str
) -> None:
    line = (
        f"compress {dense}/dense.onnx -o {dense}/out.onnx --scheme full"
        f" --frames {dense}/frames --map {dense}/map.toml --verify-frames 0"
    )
    note = "quantize-int8: scheme full: "

    assert command(*line.split()) == 0
    assert note not in capsys.readouterr().out
    assert command(*words.format(line).split()) == 0
    assert note in capsys.readouterr().out


def test_quiet_leaves_results_and_errors(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("inspect", files / "in.onnx", "-q") == 0
    shown = capsys.readouterr()
    assert "camera" in shown.out
    assert command("-q", "inspect", "none.onnx") == 1
    assert "none.onnx: no such file" in capsys.readouterr().err


def test_quiet_listeners_hear_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    set_verbosity(Verbosity.QUIET)
    with listening(stages=True) as listener:
        listener.on_progress("collect", 0, 1, "")
        listener.on_warning("a file is damaged")
    assert capsys.readouterr().err == ""


def test_one_run_prints_json(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("--json", "list", "targets") == 0
    assert capsys.readouterr().out.startswith("{")
    assert command("list", "targets") == 0
    assert capsys.readouterr().out.startswith("targets")


def test_a_run_is_quiet_only_once(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("-q", "list", "targets") == 0
    assert command("list", "targets") == 0
    with listening() as listener:
        listener.on_warning("a file is damaged")
    assert "warning: a file is damaged" in capsys.readouterr().err


class Clock:
    """A clock that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_off_a_terminal_progress_is_a_line_now_and_then() -> None:
    said, clock = list[str](), Clock()
    lines = ProgressLines(said.append, clock=clock)
    for done in range(101):
        clock.now = done * 0.3
        lines.on_progress("calibrate", done, 100, "frames")

    assert said == [
        "calibrate: 34/100 frames, 20 s left",
        "calibrate: 68/100 frames, 10 s left",
    ]


def test_a_short_run_writes_no_progress() -> None:
    said, clock = list[str](), Clock()
    lines = ProgressLines(said.append, clock=clock)
    clock.now = EVERY_S / 2
    lines.on_progress("calibrate", 1, 2, "frames")

    assert said == []


def test_every_stage_of_a_long_job_is_a_line() -> None:
    said = list[str]()
    lines = ProgressLines(said.append, stages=True, clock=Clock())
    for stage in ("collect", "learn", "learn"):
        lines.on_progress(stage, 0, 1, "")

    assert said == ["collect", "learn"]


def test_progress_without_a_name_has_no_space_before_the_comma() -> None:
    said, clock = list[str](), Clock()
    lines = ProgressLines(said.append, clock=clock)
    clock.now = EVERY_S
    lines.on_progress("frames", 0, 8, "")
    clock.now = 2 * EVERY_S
    lines.on_progress("frames", 7, 8, "")

    assert said == ["frames: 0/8", "frames: 7/8, 1 s left"]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        *((0, "0 s"), (0.3, "1 s"), (40, "40 s"), (200, "3 min")),
        *((3599, "1 h 0 min"), (7500, "2 h 5 min")),
    ],
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text
