"""What a command imports before it works: most of a short command's time."""

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

HEAVY = frozenset(
    {
        "gymnasium",
        "highway_env",
        "matplotlib",
        "numba",
        "numpy",
        "onnx",
        "onnx_ir",
        "onnxruntime",
        "onnxsim",
        "pandas",
        "pydantic",
        "ray",
        "scipy",
        "sympy",
        "torch",
    }
)
"""Packages that take from 0.07 s to seconds to import."""

SCRIPT = """
import contextlib, io, json, sys
from me2e_compress.cli import main
found = {}
for words in json.loads(sys.argv[1]):
    sys.argv = ["me2e-compress", *words]
    with contextlib.redirect_stdout(io.StringIO()):
        code = main()
    found[words[0]] = [code, sorted(sys.modules)]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def imported() -> Mapping[str, frozenset[str]]:
    """The modules that are there after commands, run one after another, by command."""
    commands = (["--help"],)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, json.dumps(commands)],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    found = json.loads(done.stdout)
    assert [code for code, _ in found.values()] == [0] * len(commands)
    return {name: frozenset(modules) for name, (_, modules) in found.items()}


@pytest.mark.parametrize(("command", "needs"), [("--help", frozenset())])
def test_no_heavy_package_is_imported(
    imported: Mapping[str, frozenset[str]], command: str, needs: frozenset[str]
) -> None:
    assert imported[command] & HEAVY <= needs


@pytest.mark.parametrize(("command", "most"), [("--help", 400)])
def test_few_modules_are_imported(
    imported: Mapping[str, frozenset[str]], command: str, most: int
) -> None:
    assert len(imported[command]) <= most
