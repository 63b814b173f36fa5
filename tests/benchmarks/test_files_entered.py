import importlib
import sys
from pathlib import Path

import pytest

from benchmarks.files_entered import Entered

CALLED = """
import trip.imported

def run():
    return list(map(lambda x: x, trip.imported.NUMBERS))
"""

IMPORTED = """
def count():
    return [0, 1]

class Body:
    x = count()

NUMBERS = count()
"""


@pytest.fixture
def entered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Entered:
    """What ran of a package of two files, one of which is only imported."""
    package = tmp_path / "trip"
    package.mkdir()
    for name, text in (("__init__", ""), ("called", CALLED), ("imported", IMPORTED)):
        (package / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    found = Entered(package)
    found.during(lambda: importlib.import_module("trip.called").run())
    for name in ("trip", "trip.called", "trip.imported"):
        del sys.modules[name]
    return found


def test_functions_that_ran_count_by_file(entered: Entered) -> None:
    assert entered.functions() == {Path("called.py"): 2}


def test_files_executed_at_import_are_apart(entered: Entered) -> None:
    names = {"__init__.py", "called.py", "imported.py"}
    assert {path.name for path in entered.imported} == names
