"""``profile --energy``: joules beside the latencies, or why there are none."""

import json
from pathlib import Path

import pytest

from me2e_compress.marks import IN_JSON
from me2e_compress.runtime.energy import EnergyResult
from tests.cli.conftest import Command, strict
from tests.docs.documents import faults

F = (
    "profile",
    "dense.onnx",
    "frames",
    "-o",
    "trace.json",
    "--samples",
    "2",
    "--by-module",
)


def recording(folder: Path, watts: float = 30.0) -> str:
    """Six minutes at ten frames a second, ten seconds idle around them."""
    seconds = range(381)
    record = {
        "time_s": list(seconds),
        "frames": [10 * min(max(0, second - 10), 360) for second in seconds],
        "watts": [watts if 10 < second <= 370 else 12.0 for second in seconds],
        "device": "Orin NX",
        "scope": "VDD_IN",
    }
    (folder / "orin.json").write_text(json.dumps(record))
    return "recorded:orin.json"


@pytest.fixture
def here(dense: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(dense)
    return dense


def test_joules_are_shown_and_written(
    command: Command, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(*F, "--energy", recording(here), "--energy-out", "j.json") == 0

    found = EnergyResult.load(here / "j.json")
    assert found.j_per_frame == pytest.approx(3.0, rel=0.01)
    shown = capsys.readouterr().out
    assert "energy: 3 J a frame (3 to 3)" in " ".join(shown.split())
    assert "recorded-power-integrated of Orin NX (VDD_IN)" in " ".join(shown.split())


def test_the_file_lies_beside_the_trace_and_is_as_documented(
    command: Command, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(*F, "--energy", recording(here), "--json") == 0

    shown = strict(capsys.readouterr().out)
    assert faults("profile", shown) == []
    written = json.loads((here / "trace.energy.json").read_text())
    assert written == IN_JSON | shown["energy"]


def test_no_counter_is_no_figure_and_no_error(
    command: Command, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(*F, "--energy", 'rapl{root="nowhere"}', "--json") == 0

    shown = strict(capsys.readouterr().out)
    assert faults("profile", shown) == []
    reason = "no energy counter answers (rapl: no nowhere)"
    assert (shown["energy"]["joules"], shown["energy"]["reason"]) == (None, reason)
    assert f"energy: not measured: {reason}" in shown["verdict"]


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (("--energy", "sun"), "no energy counter 'sun'; there are auto, nvml"),
        (("--energy", "recorded:no.csv"), "no.csv: No such file"),
        (("--energy-out", "j.json"), "there is no --energy to write"),
    ],
)
def test_what_cannot_be_asked_is_one_line_before_any_work(
    words: tuple[str, ...],
    fault: str,
    command: Command,
    here: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert command(*F, *words) == 1

    assert fault in capsys.readouterr().err
    assert not (here / "trace.json").exists()


def test_a_counter_that_stands_still_is_one_line(
    command: Command, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(*F, "--energy", recording(here, watts=0.0)) == 1

    assert "energy recording: the counter stands still" in capsys.readouterr().err
