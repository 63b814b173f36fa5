"""What fails where packages are missing: run as a script, each case in a process.

python tests/support/blocked_imports.py CASES.json

CASES.json maps a name to the modules that are not there. Printed is, by name, the error
of every module of ours that cannot be imported, that of every public name that cannot
be had, and what `--help` of every command ends with: its exit code, and the text.
"""

import contextlib
import importlib
import io
import json
import os
import pkgutil
import sys
import tempfile
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from types import ModuleType


def error_of(action: Callable[[], object]) -> str:
    """Say how an action fails, whatever it is: the test names it; empty if it works."""
    try:
        action()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def unimportable(package: ModuleType) -> dict[str, str]:
    """Import every module below a package; return those that fail, and how."""
    found = dict[str, str]()
    for each in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        if each.name.endswith("__main__"):
            continue
        if error := error_of(partial(importlib.import_module, each.name)):
            found[each.name] = error
        elif each.ispkg:
            found |= unimportable(sys.modules[each.name])
    return found


def helped(command: str) -> tuple[int, str]:
    """Ask a command for its options."""
    from me2e_compress.cli import main

    said, codes = io.StringIO(), list[int]()
    sys.argv = ["me2e-compress", command, "--help"]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        error = error_of(lambda: codes.append(main()))
    return (1, error) if error else (codes[0], said.getvalue())


def failures(gone: Collection[str]) -> dict[str, object]:
    """Look for what fails without some modules, as if they were not installed."""
    for name in [each for each in sys.modules if each.partition(".")[0] in gone]:
        del sys.modules[name]  # a base package takes it where it is there
    sys.modules |= dict.fromkeys(gone)  # type: ignore[arg-type]  # None: not to be had
    package = importlib.import_module("me2e_compress")
    app = importlib.import_module("me2e_compress.cli.app")
    names = {n: error_of(partial(getattr, package, n)) for n in package.__all__}
    return {
        "help": {command: helped(command) for command in app.COMMANDS},
        "modules": unimportable(package),
        "names": {name: error for name, error in names.items() if error},
    }


def main() -> None:
    """Look at each case in a fork of this process, which has what takes long.

    Not onnxruntime: its threads would not be there after a fork.
    """
    cases = json.loads(Path(sys.argv[1]).read_text())
    base = ("numpy", "onnx_ir", "pydantic", "scipy.optimize", "rich", "cyclopts")
    for name in (*base, "torch", "numba", "highway_env", "matplotlib.pyplot"):
        importlib.import_module(name)
    answers = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, gone in cases.items():
            answer = Path(folder) / name
            if (child := os.fork()) == 0:
                answer.write_text(json.dumps(failures(gone)))
                os._exit(0)
            os.waitpid(child, 0)
            answers[name] = json.loads(answer.read_text())
    sys.stdout.write(json.dumps(answers))


if __name__ == "__main__":
    main()
