"""Commands that open a session take a provider and libraries of operators."""

from pathlib import Path

import pytest

from tests.cli.conftest import Command


def words(folder: Path, name: str) -> list[str | Path]:
    """Return a command that opens a session, and its arguments."""
    model, frames = folder / "dense.onnx", folder / "frames"
    if name == "compare":
        return [name, model, model, frames]
    recording = [] if name == "evaluate" else [frames]
    return [name, model, *recording, "-o", folder / "out.json"]


@pytest.mark.parametrize("name", ["calibrate", "compare", "evaluate", "profile"])
def test_a_library_that_is_missing_is_one_line(
    name: str, command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    library = dense / "none.so"

    assert command(*words(dense, name), "--plugins", library) == 1

    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.endswith(f"plugins library {library}: no such file")
