"""Commands that open a session take a provider and libraries of operators."""

from pathlib import Path

import pytest

import me2e_compress as me2e
from me2e_compress.runtime.providers import CpuProvider
from tests.cli.conftest import Command

COMMANDS = (
    *("calibrate", "compare", "compress", "evaluate", "profile", "search"),
    "sensitivity",
)


def words(folder: Path, name: str) -> list[str | Path]:
    """Return a command that opens a session, and its arguments."""
    model, frames = folder / "dense.onnx", folder / "frames"
    if name == "compress":
        return [name, model, "-r", "full", "--frames", frames, "-o", folder / "s.onnx"]
    if name == "search":
        return [name, model, frames, "--max-mb", "9", "-o", folder / "r.toml"]
    if name == "compare":
        return [name, model, model, frames]
    recording = [] if name == "evaluate" else [frames]
    return [name, model, *recording, "-o", folder / "out.json"]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_library_that_is_missing_is_one_line(
    name: str, command: Command, dense: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    library = dense / "none.so"

    assert command(*words(dense, name), "--plugins", library) == 1

    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.endswith(f"plugins library {library}: no such file")


def test_compress_runs_every_graph_on_the_provider(
    dense: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[tuple[Path, ...]] = []
    library = dense / "lib.so"
    library.touch()
    monkeypatch.setattr(
        CpuProvider, "attach", lambda self, options: opened.append(self.plugins)
    )
    options = me2e.CompressOptions(
        module_map=dense / "map.toml", provider=CpuProvider(plugins=(library,))
    )

    me2e.compress(
        dense / "dense.onnx", dense / "s.onnx", "full", dense / "frames", options
    )

    assert opened
    assert set(opened) == {(library,)}
