"""What a kill leaves at any write: files are whole, the user's stay, runs go on."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from me2e_compress import graph
from tests.cli.conftest import Command

MINE = "mine.txt"
WRITES = ("replace", "link", "unlink", "rmdir")
COMMANDS = {
    "compress": "compress dense.onnx -o out.onnx -r full --frames frames",
    "search": "search dense.onnx frames -o out.toml --max-mb 1 --map map.toml",
    "sensitivity": "sensitivity dense.onnx frames -o out.toml --map map.toml",
}


def contents(folder: Path) -> dict[str, bytes]:
    """Read all files of a folder, by name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def copies(
    dense: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[pytest.MonkeyPatch], list[Path]]:
    """Copy the folder before every write in it, as a kill would leave it."""

    def begin(patch: pytest.MonkeyPatch) -> list[Path]:
        made = list[Path]()
        place = tmp_path_factory.mktemp("killed")

        def first(name: str) -> Callable[..., object]:
            real = getattr(os, name)

            def call(*given: object, **options: object) -> object:
                if str(dense) in str(Path(str(given[0])).absolute()):
                    made.append(shutil.copytree(dense, place / str(len(made))))
                return real(*given, **options)

            return call

        for name in WRITES:
            patch.setattr(os, name, first(name))
        return made

    return begin


def is_same_each_run(name: str) -> bool:
    """Return whether a file holds no times."""
    return not name.startswith(".") and not name.endswith(".report.json")


def check_whole(folder: Path) -> None:
    """Fail where a file that is not hidden is none."""
    for path in folder.iterdir():
        if path.suffix == ".onnx":
            graph.load(path)
        elif path.suffix == ".json" and not path.name.startswith("."):
            json.loads(path.read_text())


@pytest.mark.parametrize("name", COMMANDS)
def test_a_kill_at_any_write_leaves_whole_files_and_the_next_run_works(
    command: Command,
    dense: Path,
    monkeypatch: pytest.MonkeyPatch,
    copies: Callable[[pytest.MonkeyPatch], list[Path]],
    name: str,
) -> None:
    words = COMMANDS[name].split()
    (dense / MINE).write_text("mine")
    monkeypatch.chdir(dense)
    assert command(*words) == 0  # what is replaced is there
    first = contents(dense)
    with pytest.MonkeyPatch.context() as patch:
        left = copies(patch)
        assert command(*words) == 0
    assert left
    for folder in left:
        check_whole(folder)
        monkeypatch.chdir(folder)
        assert command(*words) == 0
        again = contents(folder)
        assert {each: again[each] for each in first if is_same_each_run(each)} == {
            each: text for each, text in first.items() if is_same_each_run(each)
        }
