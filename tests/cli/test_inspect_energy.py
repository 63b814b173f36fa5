"""``inspect --modelled-energy``: joules by published figures, never called measured."""

from pathlib import Path

import pytest

from tests.cli.conftest import Command, strict
from tests.docs.documents import faults


def test_modelled_energy_has_a_key_of_its_own(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("inspect", dense / "dense.onnx", "--modelled-energy", "7nm", "--json")
    assert command(*words) == 0

    shown = strict(capsys.readouterr().out)
    assert faults("inspect", shown) == []
    assert shown["modelled_energy"]["macs"] == {"float32": 4 * 16 * 32}
    assert shown["modelled_energy"]["modelled_j_per_frame"] > 0


def test_the_table_says_that_nothing_is_measured(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("inspect", dense / "dense.onnx", "--modelled-energy", "45nm") == 0

    shown = " ".join(capsys.readouterr().out.split())
    assert "Modelled energy (45nm), not measured" in shown
    assert "Horowitz, ISSCC 2014" in shown


def test_no_such_process_is_one_line(
    command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("inspect", dense / "dense.onnx", "--modelled-energy", "1nm") == 1

    assert "no process '1nm'; there are 45nm, 7nm" in capsys.readouterr().err
