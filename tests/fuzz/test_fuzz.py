"""No input may end in a traceback, change a file that is there, or leave another."""

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from me2e_compress.cli import main
from tests.fuzz import cases
from tests.fuzz.cases import Case
from tests.fuzz.good import write_good

GROUPS: dict[str, Callable[[Path], Iterator[Case]]] = {
    "graphs": lambda good: cases.graph_cases(drawn=80),
    "frames": lambda good: cases.frame_cases(),
    "json": lambda good: cases.json_cases(good, 8),
    "toml": lambda good: cases.toml_cases(10),
    "results": lambda good: cases.result_cases(good, 15),
    "pipelines": lambda good: cases.pipeline_cases(),
    "caches": lambda good: cases.cache_cases(),
    "outputs": lambda good: cases.output_cases(),
    "sessions": lambda good: cases.session_cases(),
}


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of good files; cases lie beside it."""
    folder = tmp_path_factory.mktemp("fuzz") / "good"
    write_good(folder, run)
    return folder


def run(*words: str | Path) -> int:
    """Run ``me2e-compress`` with these words; give its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["me2e-compress", *map(str, words)])
        return main()


@pytest.mark.parametrize("group", GROUPS)
def test_every_broken_input_is_one_line(
    group: str,
    good: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before, wrong, count = snapshot(good), list[str](), 0
    for count, case in enumerate(GROUPS[group](good), 1):
        folder = good.parent / f"{group}-{count}"
        wrong += faults(case, folder, capsys, monkeypatch)
    assert wrong == []
    assert snapshot(good) == before
    assert count >= 4


def faults(
    case: Case,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[str]:
    """Run a case in a new folder; say what is wrong with how it ended."""
    for name, content in case.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    folder.mkdir(exist_ok=True)
    monkeypatch.chdir(folder)
    code = run(*case.words)
    lines = capsys.readouterr().err.splitlines()
    error = "\n".join(line for line in lines if not line.startswith("warning: "))
    if code not in (0, 1, 2):
        yield f"{case.name}: exit code {code}: {error}"
    if code == 1 and len(error.splitlines()) != 1:
        yield f"{case.name}: not one line: {error}"
    if code == 1 and not error.isprintable():
        yield f"{case.name}: {error!r} steers a terminal"
    after = snapshot(folder)
    for name, content in case.files.items():
        if after.pop(name, None) != content:
            yield f"{case.name}: {name} was changed"
    ours = ("out",) if code else ("out", ".me2e-compress")
    for name in after:
        if name.startswith("reproducer-") and "; reproducer (" in error:
            continue  # of a pass that failed, as the message says
        if not name.startswith(ours):
            yield f"{case.name}: leaves {name}"


def snapshot(folder: Path) -> dict[str, bytes]:
    """Read every file of a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not os.path.islink(path)
    }
