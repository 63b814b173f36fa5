"""What a command imports before it works: most of a short command's time."""

import json
import subprocess
import sys
from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress import graph
from tests.support.nets import DRIVER

HEAVY = frozenset(
    [
        "gymnasium",
        "highway_env",
        "matplotlib",
        "numba",
        "numpy",
        "onnx",
        "onnx_ir",
        "onnxruntime",
        "onnxsim",
        "pydantic",
        "ray",
        "scipy",
        "sympy",
        "torch",
    ]
)
"""Packages that take from 0.07 s to seconds to import."""

OURS = "me2e_compress"

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


ONNX = frozenset({"numpy", "onnx", "onnx_ir", "onnxruntime", "pydantic", "sympy"})
"""What it takes to read a graph; onnx_ir itself imports onnx and sympy."""

LIMITS = {
    "--help": (frozenset[str](), 350),
    "inspect": (ONNX, 1180),
    "lint": (ONNX, 1200),
    "list": (ONNX, 1240),
}
"""What each may import of these, and how many modules at most that are not ours.

They run in this order in one process: each has what those before it imported.
"""


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """The modules that are there after each command."""
    file = tmp_path_factory.mktemp("start") / "small.onnx"
    graph.save(ir.from_onnx_text(DRIVER), file)
    words = {
        "--help": [],
        "inspect": [str(file)],
        "lint": [str(file), "--target", "onnxruntime"],
        "list": [],
    }
    commands = json.dumps([[name, *more] for name, more in words.items()])
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, commands],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    found = json.loads(done.stdout)
    assert {name: code for name, (code, _) in found.items()} == dict.fromkeys(words, 0)
    return {name: set(modules) for name, (_, modules) in found.items()}


@pytest.mark.parametrize("command", LIMITS)
def test_no_package_is_imported_that_the_command_does_not_need(
    imported: dict[str, set[str]], command: str
) -> None:
    allowed, most = LIMITS[command]
    theirs = [name for name in imported[command] if name.split(".")[0] != OURS]
    assert imported[command] & HEAVY <= allowed
    assert len(theirs) <= most
