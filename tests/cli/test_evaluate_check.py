"""``evaluate --check``: exit codes, the table, the document."""

import json
from pathlib import Path

import pytest

from tests.cli.conftest import Command
from tests.docs.documents import faults
from tests.workflows.test_check_model import ADAPTER, tcp_like

Captured = pytest.CaptureFixture[str]


def test_what_fits(tmp_path: Path, command: Command, capsys: Captured) -> None:
    (tmp_path / "a.toml").write_text(ADAPTER)
    words = ("evaluate", tcp_like(tmp_path / "m.onnx"), "--check")

    assert command(*words, "--adapter", tmp_path / "a.toml", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["fits"]
    assert faults("evaluate", document) == []


def test_what_is_missing(tmp_path: Path, command: Command, capsys: Captured) -> None:
    words = ("evaluate", tcp_like(tmp_path / "m.onnx"), "--check")

    assert command(*words, "--json") == 1
    shown = capsys.readouterr()
    document = json.loads(shown.out)
    assert document["status"] == "refused"
    assert faults("evaluate", document) == []
    assert "could not drive: " in shown.err
    assert not list(tmp_path.glob("*/"))


@pytest.mark.parametrize("words", [("--check",), ("blind",)])
def test_what_is_asked_for_must_be_said(
    words: tuple[str, ...], command: Command, capsys: Captured
) -> None:
    assert command("evaluate", *words) == 2
    assert "needs" in capsys.readouterr().err
