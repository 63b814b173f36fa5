"""No input may end in a traceback, change a file that is there, or leave another."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzz.cases import GROUPS, Case
from tests.fuzz.good import write_good
from tests.support.command import contents, run


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of good files; cases lie beside it."""
    folder = tmp_path_factory.mktemp("fuzz") / "good"
    write_good(folder, run)
    return folder


@pytest.mark.parametrize("group", GROUPS)
def test_every_broken_input_is_one_line(
    group: str,
    good: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before, wrong, count = contents(good), list[str](), 0
    for count, case in enumerate(GROUPS[group](good), 1):
        folder = good.parent / f"{group}-{count}"
        for name, content in case.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        folder.mkdir(exist_ok=True)
        monkeypatch.chdir(folder)
        code = run(*case.words)
        faults = faults_of(case, folder, code, capsys.readouterr().err)
        wrong += [f"{case.name}: {fault}" for fault in faults]
    assert wrong == []
    assert contents(good) == before
    assert count >= 4


def faults_of(case: Case, folder: Path, code: int, err: str) -> Iterator[str]:
    """Say what is wrong with how a case ended in its folder."""
    lines = [line for line in err.splitlines() if not line.startswith("warning: ")]
    error = "\n".join(lines)
    if code not in (0, 1, 2):
        yield f"exit code {code}: {error}"
    if code == 1 and len(lines) != 1:
        yield f"not one line: {error}"
    if code == 1 and not error.isprintable():
        yield f"{error!r} steers a terminal"
    after = contents(folder)
    for name, content in case.files.items():
        if after.pop(name, None) != content:
            yield f"{name} was changed"
    ours: tuple[str, ...] = ("out",) if code else ("out", ".me2e-compress")
    if "; reproducer (" in error:
        ours += ("reproducer-",)  # of a pass that failed, as the message says
    yield from (f"leaves {name}" for name in after if not name.startswith(ours))
