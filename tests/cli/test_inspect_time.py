"""``inspect --trace`` and ``--frames``: activations, and shares of a frame's time."""

import dataclasses
from pathlib import Path

import pytest

from me2e_compress import graph
from me2e_compress.runtime.latency_trace import LatencyTrace
from tests.cli.conftest import Command, strict
from tests.docs.documents import faults


@pytest.fixture
def trace(files: Path) -> LatencyTrace:
    return LatencyTrace(
        graph.sha256_of(files / "in.onnx"),
        "a machine",
        (40, 60),
        modules_us={"backbone": (30, 30), "occ": (20, 10), "(between nodes)": (5, 5)},
    )


def modules(
    command: Command, capsys: pytest.CaptureFixture[str], files: Path, *words: str
) -> dict[str, dict[str, object]]:
    given = ("inspect", files / "in.onnx", "--map", files / "map.toml", "--json")
    assert command(*given, *words) == 0
    shown = strict(capsys.readouterr().out)
    assert faults("inspect", shown) == []
    return {each["module"]: each for each in shown["modules"]}


def test_activations_are_weighed_and_time_is_not_made_up(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = modules(command, capsys, files)

    assert found["backbone"]["activation_bytes"] == 16
    assert found["backbone"]["unknown_activation_nodes"] == 0
    assert {each["latency_share"] for each in found.values()} == {None}


def test_shares_of_the_time_come_from_a_trace(
    command: Command,
    files: Path,
    capsys: pytest.CaptureFixture[str],
    trace: LatencyTrace,
) -> None:
    trace.save(files / "trace.json")

    found = modules(command, capsys, files, "--trace", str(files / "trace.json"))

    assert found["backbone"]["latency_share"] == pytest.approx(0.6)
    assert found["occ"]["latency_share"] == pytest.approx(0.3)
    assert found["planner"]["latency_share"] is None


def test_the_table_says_whose_time_it_is(
    command: Command,
    files: Path,
    capsys: pytest.CaptureFixture[str],
    trace: LatencyTrace,
) -> None:
    trace.save(files / "trace.json")
    words = ("--map", files / "map.toml", "--trace", files / "trace.json")

    assert command("inspect", files / "in.onnx", *words) == 0

    shown = " ".join(capsys.readouterr().out.split())
    assert "60.0%" in shown
    assert "share of a frame's time: 2 inferences on a machine" in shown


def test_shares_are_measured_on_frames(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = modules(command, capsys, files, "--frames", str(files / "frames"))

    shares = [each["latency_share"] for each in found.values()]
    measured = [share for share in shares if isinstance(share, float)]
    assert len(measured) == len(shares) == 3
    assert min(measured) > 0
    assert sum(measured) <= 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"model_sha256": "0"}, "a trace of another model than in.onnx"),
        ({"modules_us": {}}, "no times by module: profile in.onnx with --by-module"),
    ],
)
def test_a_trace_that_does_not_fit_is_one_line(
    command: Command,
    files: Path,
    capsys: pytest.CaptureFixture[str],
    trace: LatencyTrace,
    change: dict[str, object],
    said: str,
) -> None:
    dataclasses.replace(trace, **change).save(files / "t.json")  # type: ignore[arg-type]

    assert command("inspect", files / "in.onnx", "--trace", files / "t.json") == 1

    assert said in capsys.readouterr().err


def test_the_time_is_read_or_measured(
    command: Command, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--trace", files / "t.json", "--frames", files / "frames")

    assert command("inspect", files / "in.onnx", *words) == 1

    assert "--trace and --frames" in capsys.readouterr().err
