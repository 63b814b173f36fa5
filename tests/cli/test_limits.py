"""Numbers that no option takes: one line, or a word about the usage; no work."""

from pathlib import Path

import pytest

from tests.cli.conftest import Command

F = "dense.onnx frames -o out"


@pytest.mark.parametrize("value", ["nan", "inf", "-1", "1e+308"])
@pytest.mark.parametrize(
    ("line", "option"),
    [
        (f"search {F}", "--max-mb"),
        (f"search {F}", "--max-ms"),
        (f"search {F}", "--max-joules"),
        (f"sensitivity {F}", "--limit"),
        (f"sensitivity {F} --drive 1", "--drive-limit"),
        ("evaluate blind --routes 1 -o out", "--dt-ms"),
        ("evaluate blind --routes 1 -o out", "--frame-limit"),
    ],
)
def test_a_number_that_is_none(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    line: str,
    option: str,
    value: str,
) -> None:
    monkeypatch.chdir(dense)

    assert command(*line.split(), option, value) == 1

    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"{option} is {value}: it must be a finite number" in error
    assert not (dense / "out").exists()


@pytest.mark.parametrize(
    ("line", "option"),
    [
        (f"calibrate {F}", "--seed"),
        (f"calibrate {F}", "--threads"),
        ("compress dense.onnx -r exact -o out", "--seed"),
        ("compress dense.onnx -r exact -o out", "--verify-frames"),
        (f"sensitivity {F}", "--node-trials"),
        (f"search {F} --max-mb 1", "--threads"),
        (f"profile {F}", "--threads"),
        ("frames vad-tiny -n 1 -o out", "--seed"),
        ("export vad-tiny -o out", "--seed"),
        ("evaluate blind --routes 1 -o out", "--seed"),
    ],
)
def test_a_count_below_zero(
    command: Command,
    dense: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    line: str,
    option: str,
) -> None:
    monkeypatch.chdir(dense)

    assert command(*line.split(), option, "-1") == 2

    assert option in capsys.readouterr().err
    assert not (dense / "out").exists()
