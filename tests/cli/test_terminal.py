"""What a terminal shows: version, quiet, verbose, completion, progress, 80 columns."""

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from me2e_compress.base.display import Cell, Table, format_duration, table
from me2e_compress.cli import console
from me2e_compress.cli.app import COMMANDS
from me2e_compress.cli.console import (
    EVERY_S,
    ProgressLines,
    listening,
    print_table,
)
from me2e_compress.version import __version__
from tests.support.command import Cli


@pytest.fixture(autouse=True)
def _normal() -> Iterator[None]:
    yield
    console.printing.quiet = False


def test_the_version(cli: Cli) -> None:
    assert cli.done("--version").out == f"me2e-compress {__version__}\n"


def test_commands_stand_in_groups(cli: Cli) -> None:
    said = cli.done("--help").out
    for panel in COMMANDS.values():
        assert f"─ {panel} ─" in said
    assert re.findall(r"^│ (\w+) +\w", said, re.MULTILINE) == list(COMMANDS)


def test_the_shell_completes_options_of_a_command(cli: Cli) -> None:
    words = "compress --sch"
    cli.done("--install-completion --shell bash --output complete.sh")
    script = (
        f"source complete.sh; COMP_WORDS=(me2e-compress {words});"
        f" COMP_CWORD={len(words.split())}; _me2e_compress; echo ${{COMPREPLY[@]}}"
    )

    done = subprocess.run(
        ["bash", "-c", script], cwd=cli.folder, capture_output=True, text=True
    )
    assert done.stdout.split() == ["--scheme"]


@pytest.mark.parametrize("words", ["-v {}", "{} --verbose"])
def test_notes_are_for_the_verbose(cli: Cli, dense: Path, words: str) -> None:
    line = (
        "compress dense.onnx -o out.onnx --scheme full --frames frames --map map.toml"
        " --verify-frames 0"
    )
    note = "quantize-int8: scheme full, "

    assert note not in cli.done(line).out
    assert note in cli.done(words.format(line)).out


def test_quiet_leaves_results_and_errors(cli: Cli, files: Path) -> None:
    assert "camera" in cli.done("inspect in.onnx -q").out
    assert "none.onnx: no such file" in cli.refused("-q inspect none.onnx")


def test_a_run_is_quiet_only_once(cli: Cli) -> None:
    cli.done("-q list targets")
    with listening(stages=True) as listener:
        listener.on_progress("collect", 0, 1, "")
        listener.on_warning("a file is damaged")
    assert cli.capsys.readouterr().err == ""
    cli.done("list targets")
    with listening() as listener:
        listener.on_warning("a file is damaged")
    assert "warning: a file is damaged" in cli.capsys.readouterr().err


STEPS = [(done * 0.3, "calibrate", done, 100, "frames") for done in range(101)]


@pytest.mark.parametrize(
    ("told", "stages", "said"),
    [
        (STEPS, False, ["calibrate: 34/100 frames, 20 s left",
                        "calibrate: 68/100 frames, 10 s left",
                        "calibrate: 100/100 frames"]),
        ([(EVERY_S / 2, "calibrate", 1, 2, "frames")], False, []),
        ([(0.0, stage, 0, 1, "") for stage in ("collect", "learn", "learn")],
         True, ["collect", "learn"]),
        ([(EVERY_S, "frames", 0, 8, ""), (2 * EVERY_S, "frames", 7, 8, "")],
         False, ["frames: 0/8", "frames: 7/8, 1 s left"]),
        ([(EVERY_S, "inferences", 33, 0, "")], False, ["inferences: 33"]),
    ],
    ids=["a line now and then", "none of a short run", "every stage", "no name",
         "no total"],
)  # fmt: skip
def test_off_a_terminal_progress_is_lines(
    told: list[tuple[float, str, int, int, str]], stages: bool, said: list[str]
) -> None:
    lines, now = list[str](), [0.0]
    progress = ProgressLines(lines.append, stages=stages, clock=lambda: now[0])
    for now[0], *words in told:
        progress.on_progress(*words)  # type: ignore[arg-type]

    assert lines == said


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        *((0, "0 s"), (0.3, "1 s"), (40, "40 s"), (200, "3 min")),
        *((3599, "1 h 0 min"), (7500, "2 h 5 min")),
    ],
)
def test_durations(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text


NODE = "/planner/agent_layer/cross_attn/value/MatMul"
COLUMNS = ("module", "node", "op", "rule", "why")


@pytest.fixture
def width(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(console.console, "width", 80)
    return 80


def printed(capsys: pytest.CaptureFixture[str], *row: str) -> list[str]:
    print_table(table("Nodes", COLUMNS, [row], words=len(row)))
    return [line.rstrip() for line in capsys.readouterr().out.splitlines()]


def test_words_that_fit_stand_in_columns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console.console, "width", 100)
    lines = printed(capsys, "planner", NODE, "MatMul", "layer", "a product")

    assert lines[1].replace("┃", "").split() == list(COLUMNS)
    assert NODE in lines[3]


def test_words_that_do_not_fit_stand_below_each_other_and_sentences_wrap(
    capsys: pytest.CaptureFixture[str], width: int
) -> None:
    below = ["    node: planner", "    op: MatMul", f"    rule: as_{NODE}"]
    lines = printed(capsys, NODE, "planner", "MatMul", f"as_{NODE}", "")
    assert lines == ["Nodes", NODE, *below]
    lines = printed(capsys, "planner", NODE, "MatMul", "layer", "int8 " * 20)
    assert all(len(line) <= width for line in lines)
    assert sum(line.count("int8") for line in lines) == 20
    assert any(NODE in line for line in lines)


@pytest.mark.usefixtures("width")
@pytest.mark.parametrize(("count", "shown"), [(2, True), (6, False)])
def test_intervals_stand_where_they_fit_and_are_missed_where_not(
    capsys: pytest.CaptureFixture[str], count: int, shown: bool
) -> None:
    """+13.4 points stood there without the interval that the caption promises."""
    row = (Cell("full"), *[Cell("+13.4", "-0.3 to +40.6")] * count)
    columns = ("variant", *[f"score {at}" for at in range(count)])
    print_table(Table("Scores", columns, (row,), "Each with its interval."))

    said = capsys.readouterr().out
    assert ("-0.3 to +40.6" in said) is shown
    assert ("Intervals: in a terminal of 120 columns." in said) is not shown
