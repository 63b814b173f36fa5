"""The script of docs/engine-dumps.md feeds an engine as a graph is fed here."""

import sys
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import Session, SessionPort, replay
from me2e_compress.shipped.drivers import shipped
from tests.command import Cli, cli, command
from tests.docs.pages import ROOT, blocks
from tests.frames import record

__all__ = ["cli", "command"]

PAGE = ROOT / "docs" / "engine-dumps.md"


class Runner:
    """Runs a graph as polygraphy runs an engine; answers share one memory."""

    def __init__(self, path: str) -> None:
        self.session = Session(Path(path))
        self.memory = dict[str, Array]()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def get_input_metadata(self) -> Mapping[str, SessionPort]:
        return self.session.inputs

    def infer(self, feeds: Mapping[str, Array]) -> dict[str, Array]:
        for name, value in self.session.run(feeds).items():
            held: Any = self.memory.setdefault(name, np.array(value))
            held[...] = value
        return self.memory


@pytest.fixture
def dumped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Run the script of the page over three frames of two scenes."""
    drawn = np.random.default_rng(0)
    shapes = Session(shipped("highway")).inputs
    record(tmp_path / "frames", [
        {
            name: np.array([1]) if name == "command"
            else drawn.normal(size=np.array(port.shape, int)).astype(np.float32)
            for name, port in shapes.items() if not name.startswith("prev_")
        }
        for _ in range(3)
    ], (0, 2))  # fmt: skip
    package: dict[str, dict[str, Any]] = {
        "polygraphy.backend.common": {"BytesFromPath": str},
        "polygraphy.backend.trt": {"EngineFromBytes": str, "TrtRunner": Runner},
    }
    for name in ("polygraphy", "polygraphy.backend", *package):
        module = types.ModuleType(name)
        module.__dict__.update(package.get(name, {}))
        monkeypatch.setitem(sys.modules, name, module)
    (script,) = blocks(PAGE, "python")
    paths = [str(each) for each in (shipped("highway"), tmp_path / "frames")]
    monkeypatch.setattr(sys, "argv", ["dump.py", *paths, str(tmp_path / "dump")])
    exec(script.text, {})
    return tmp_path / "dump"


def test_the_script_dumps_what_a_replay_answers(dumped: Path) -> None:
    frames = CalibrationSet(dumped.with_name("frames"))
    for path, wanted in zip(
        sorted(dumped.iterdir()),
        replay(Session(shipped("highway")), frames),
        strict=True,
    ):
        found = dict(np.load(path))
        assert path.name in {each.name for each in frames.files}
        for name, array in wanted.items():
            right: Any = array
            np.testing.assert_allclose(found[name], right, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    "words", ["highway highway", "highway highway frames --outputs dump"]
)
def test_two_graphs_or_one_and_its_engine(words: str, cli: Cli) -> None:
    said = cli(f"compare {words}")
    assert said.code == 2
    assert "expected" in said.err


def test_the_command_of_the_page_reads_it(dumped: Path, cli: Cli) -> None:
    frames = dumped.with_name("frames")
    found = cli.document(f"compare highway {frames} --outputs {dumped}")
    assert found["verdict"][0].startswith("the engine answers as its graph does")
    assert found["state"].startswith("the engine's own")
