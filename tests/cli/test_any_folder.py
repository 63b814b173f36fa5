"""Models with weights in files of their own, from any working directory."""

from collections.abc import Callable
from pathlib import Path

import onnx_ir as ir
import pytest

from tests.cli.conftest import Command
from tests.frames import record
from tests.nets import conv_attention, image


@pytest.fixture
def apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is not the working one: all weights of its model lie apart."""
    home = tmp_path / "models"
    home.mkdir()
    model = conv_attention()
    for node in model.graph:
        node.metadata_props.clear()
    ir.save(
        model,
        home / "m.onnx",
        format="protobuf",
        external_data="weights.bin",
        size_threshold_bytes=0,
    )
    record(home / "frames", [image(0), image(1)])
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return Path("../models")


COMMANDS: dict[str, Callable[[Path], tuple[str | Path, ...]]] = {
    "inspect": lambda home: (home / "m.onnx",),
    "plan": lambda home: (home / "m.onnx",),
    "lint": lambda home: (home / "m.onnx",),
    "calibrate": lambda home: (home / "m.onnx", home / "frames", "-o", "r.json"),
    "compare": lambda home: (home / "m.onnx", home / "m.onnx", home / "frames"),
    "profile": lambda home: (home / "m.onnx", home / "frames", "-o", "t.json"),
    "compress": lambda home: (
        *(home / "m.onnx", "-r", "full", "--frames", home / "frames"),
        *("-o", "small.onnx"),
    ),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_model_with_external_weights_works_from_any_folder(
    command: Command, apart: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(name, *COMMANDS[name](apart)) == 0, capsys.readouterr().err


@pytest.mark.parametrize("name", ["inspect", "lint", "compress"])
def test_weights_outside_the_model_s_folder_are_one_line_and_nothing_is_written(
    command: Command, apart: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = apart / "weights.bin"
    weights.rename(apart.parent / "private.bin")
    weights.symlink_to(apart.parent.resolve() / "private.bin")
    assert command(name, *COMMANDS[name](apart)) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "the data of tokens lie at 'weights.bin'" in line
    assert "private.bin, outside the model's folder: not read" in line
    assert list(Path().iterdir()) == []
