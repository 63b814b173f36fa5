"""What fails where packages are missing: run as a script, each case in a process.

python tests/blocked_imports.py CASES.json

CASES.json maps a name to the modules that are not there. Printed is, by name, the error
of every module of ours that cannot be imported, that of every public name that cannot
be had, and what `--help` of every command ends with: its exit code, and the text.
"""

import contextlib
import importlib
import importlib.abc
import importlib.machinery
import io
import json
import os
import pkgutil
import sys
import tempfile
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from types import ModuleType


class NotInstalled(importlib.abc.MetaPathFinder):
    """Finds nothing below some names, as if they had never been installed."""

    def __init__(self, theirs: object, gone: Collection[str]) -> None:
        self.theirs, self.gone = theirs, frozenset(gone)

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,
        target: ModuleType | None = None,
    ) -> importlib.machinery.ModuleSpec | None:
        """Ask the finder in whose place this one stands, unless the name is gone."""
        if fullname.partition(".")[0] in self.gone:
            return None
        found: importlib.machinery.ModuleSpec | None = self.theirs.find_spec(  # type: ignore[attr-defined]
            fullname, path, target
        )
        return found

    def __getattr__(self, name: str) -> object:
        """Be the other finder in all else: metadata of packages is found by it."""
        return getattr(self.theirs, name)


def unimportable(package: ModuleType) -> Iterator[tuple[str, str]]:
    """Import every module below a package; yield those that fail, and how."""
    for each in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        if each.name.endswith("__main__"):
            continue
        try:
            module = importlib.import_module(each.name)
        except Exception as error:  # whatever it is, the test names it
            yield each.name, f"{type(error).__name__}: {error}"
            continue
        if each.ispkg:
            yield from unimportable(module)


def unusable(package: ModuleType) -> Iterator[tuple[str, str]]:
    """Ask for every public name; yield those that cannot be had, and why."""
    for name in package.__all__:
        try:
            getattr(package, name)
        except Exception as error:  # whatever it is, the test names it
            yield name, f"{type(error).__name__}: {error}"


def helped(command: str) -> tuple[int, str]:
    """Ask a command for its options."""
    from me2e_compress.cli import main

    said = io.StringIO()
    sys.argv = ["me2e-compress", command, "--help"]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            code = main()
        except Exception as error:  # whatever it is, the test names it
            return 1, f"{type(error).__name__}: {error}"
    return code, said.getvalue()


def found(gone: Collection[str]) -> dict[str, object]:
    """Look for what fails without some modules."""
    for name in [each for each in sys.modules if each.partition(".")[0] in gone]:
        del sys.modules[name]  # a base package takes it where it is there
    sys.meta_path[:] = [NotInstalled(each, gone) for each in sys.meta_path]
    package = importlib.import_module("me2e_compress")
    app = importlib.import_module("me2e_compress.cli.app")
    helps = {command: helped(command) for command in app.COMMANDS}
    return {
        "modules": dict(unimportable(package)),
        "help": helps,
        "names": dict(unusable(package)),
    }


def main() -> None:
    """Look at each case in a fork of this process, which has what takes long.

    Not onnxruntime: its threads would not be there after a fork.
    """
    cases = json.loads(Path(sys.argv[1]).read_text())
    base = ("numpy", "onnx_ir", "pydantic", "scipy.optimize", "rich", "typer")
    for name in (*base, "torch", "numba", "highway_env", "matplotlib.pyplot"):
        importlib.import_module(name)
    answers = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, gone in cases.items():
            answer = Path(folder) / name
            if (child := os.fork()) == 0:
                answer.write_text(json.dumps(found(gone)))
                os._exit(0)
            os.waitpid(child, 0)
            answers[name] = json.loads(answer.read_text())
    sys.stdout.write(json.dumps(answers))


if __name__ == "__main__":
    main()
