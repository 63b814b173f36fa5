"""Runs the command as a shell does, and keeps what it said."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.cli import main
from tests.docs.documents import faults
from tests.support.frames import record
from tests.support.nets import DRIVER, DRIVER_MAP, parsed, stored

Command = Callable[..., int]


@dataclass(frozen=True)
class Said:
    """How a run of the command ended, and what it said."""

    code: int
    out: str
    err: str

    @property
    def words(self) -> str:
        """The output however wide the terminal is: words one space apart."""
        return " ".join(self.out.split())


@dataclass(frozen=True)
class Cli:
    """Runs the command in one folder, which is the working directory."""

    command: Command
    folder: Path
    capsys: pytest.CaptureFixture[str]

    def __call__(self, line: str, *more: str | Path) -> Said:
        """Run the words of a line, and more words that may hold spaces."""
        self.capsys.readouterr()
        code = self.command(*line.split(), *more)
        said = self.capsys.readouterr()
        return Said(code, said.out, said.err)

    def done(self, line: str, *more: str | Path) -> Said:
        """Run what must succeed."""
        said = self(line, *more)
        assert said.code == 0, said.err
        return said

    def document(self, line: str, *more: str | Path, code: int = 0) -> Any:
        """Return what ``--json`` prints; its keys are those of docs/json.md."""
        said = self(line, *more, "--json")
        assert said.code == code, said.err
        found = strict(said.out)
        assert faults(line.split()[0], found) == []
        return found

    def refused(self, line: str, *more: str | Path) -> str:
        """Run what must be refused: one line says why, and no file changes."""
        before = contents(self.folder)
        said = self(line, *more)
        assert said.code == 1
        lines = [e for e in said.err.splitlines() if not e.startswith("warning: ")]
        assert len(lines) == 1, said.err
        assert contents(self.folder) == before
        return lines[0]


def run(*words: str | Path) -> int:
    """Run ``me2e-compress`` with these words; give its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["me2e-compress", *map(str, words)])
        return main()


@pytest.fixture
def command() -> Command:
    return run


@pytest.fixture
def cli(
    command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Cli:
    """The command in the folder of the test."""
    monkeypatch.chdir(tmp_path)
    return Cli(command, tmp_path, capsys)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with a model, its map and its frames."""
    graph.save(parsed(DRIVER), tmp_path / "in.onnx")
    (tmp_path / "map.toml").write_text(DRIVER_MAP)
    write_frames(tmp_path / "frames", camera=np.zeros((1, 4), np.float32))
    return tmp_path


@pytest.fixture
def dense(files: Path) -> Path:
    """The folder with a model that has a layer to quantize."""
    model = parsed(
        "dense (float[4,16] camera, float[16,32] w) => (float[4,32] plan) {"
        ' ["/backbone/Relu"] a = Relu(camera)\n'
        ' ["/plan_head/MatMul"] plan = MatMul(a, w) }'
    )
    draws = np.random.default_rng(0).normal(size=(16, 32)).astype(np.float32)
    graph.save(stored(model, {"w": draws}), files / "dense.onnx")
    camera = np.random.default_rng(1).normal(size=(4, 16)).astype(np.float32)
    shutil.rmtree(files / "frames")
    write_frames(files / "frames", camera=camera)
    return files


def strict(text: str) -> Any:
    """Read JSON as programs do: it knows neither NaN nor Infinity."""
    return json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} in JSON"))


def contents(folder: Path) -> dict[str, bytes]:
    """Read all files of a folder, by name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def write_frames(folder: Path, **arrays: np.ndarray) -> Path:
    """Write one scene of two frames, the second one unit more than the first."""
    moved = (
        {name: array + array.dtype.type(index) for name, array in arrays.items()}
        for index in range(2)
    )
    return record(folder, list(moved))
