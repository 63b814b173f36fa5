"""What docs/stacks.md shows is done."""

from pathlib import Path

import pytest

from me2e_compress.runtime.stack.stack_file import StackFile
from me2e_compress.zoo.shipped import sample_frames, shipped
from tests.cli.conftest import Command, command
from tests.docs.pages import ROOT, blocks
from tests.stacks import dense_frames, write_dense

__all__ = ["command"]

PAGE = ROOT / "docs" / "stacks.md"


def test_the_example_of_the_page_runs(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: Command,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (toml, *_), (script, *_) = blocks(PAGE, "toml"), blocks(PAGE, "python")
    Path("stack.toml").write_text(toml.text)
    exec(script.text, {})
    recorded = sample_frames(shipped("highway"))
    assert recorded is not None
    Path("frames").symlink_to(recorded)
    first, *_ = blocks(PAGE, "sh")
    for line in first.text.splitlines():
        assert command(*line.split()[1:]) == 0, line

    assert (
        "plan displacement: mean 0.0000 m, largest 0.0000 m" in capsys.readouterr().out
    )


def test_the_other_commands_of_the_page_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    write_dense(tmp_path)
    dense_frames(tmp_path)
    _, *others = blocks(PAGE, "sh")

    for line in "".join(each.text for each in others).splitlines():
        assert command(*line.split()[1:]) == 0, line


def test_the_state_of_the_page_is_read(tmp_path: Path) -> None:
    (state,) = (b for b in blocks(PAGE, "toml") if b.text.startswith("[state]"))
    path = tmp_path / "stack.toml"
    path.write_text('[[part]]\nname = "head"\nfile = "head.onnx"\n' + state.text)

    assert [each.first for each in StackFile.load(path).state.values()] == [
        *("zeros", "anchors.npy", "head.query_embedding.weight", "begin.feat")
    ]
