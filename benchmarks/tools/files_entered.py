"""How many files of the project one command enters.

    python -m benchmarks.tools.files_entered [--call CALL] [-v] [--tree DIRECTORY]

Runs a command in this process: ``compress m.onnx -r full --frames F -o o.onnx`` on the
graph of `benchmarks.subjects.seven_nodes`, or ``evaluate highway --routes 1``. Counts
the files of ``me2e_compress`` in which a function ran (a lambda, a comprehension and a
generator too). What runs while a module is being imported, and methods that dataclasses
generate, do not count; files that were only imported are counted apart. ``-v`` lists
the files, each with its functions; ``--tree`` measures another checkout.
"""

import argparse
import contextlib
import inspect
import io
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType

from benchmarks.subjects import seven_nodes

PACKAGE = "me2e_compress"


@dataclass
class Entered:
    """Notes which code of a package runs.

    Args:
        package: Folder of the package.
    """

    package: Path
    called: set[CodeType] = field(default_factory=set)
    imported: set[Path] = field(default_factory=set)
    _base: FrameType | None = None

    def during(self, run: Callable[[], object]) -> None:
        """Run something, in this thread and those that it starts."""
        self._base = inspect.currentframe()
        threading.setprofile(self._note)
        sys.setprofile(self._note)
        try:
            run()
        finally:
            sys.setprofile(None)
            threading.setprofile(None)

    def functions(self) -> Counter[Path]:
        """Count the functions that ran, by file."""
        return Counter(self._file(code) for code in self.called)

    def _note(self, frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event != "call" or code in self.called or not self._ours(code):
            return
        if code.co_name == "<module>":
            self.imported.add(self._file(code))
        elif code.co_flags & inspect.CO_OPTIMIZED and not self._importing(frame):
            self.called.add(code)  # class bodies are not optimized

    def _ours(self, code: CodeType) -> bool:
        return code.co_filename.startswith(f"{self.package}/")

    def _file(self, code: CodeType) -> Path:
        return Path(code.co_filename).relative_to(self.package)

    def _importing(self, frame: FrameType | None) -> bool:
        while frame is not None and frame is not self._base:
            if frame.f_code.co_name == "<module>":
                return True
            frame = frame.f_back
        return False


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-v", "--verbose", action="store_true")
    parser.add_argument("--call", choices=CALLS, default="compress")
    parser.add_argument("--tree", type=Path, default=Path(__file__).parents[2])
    options = parser.parse_args(argv)
    tree = options.tree.resolve()
    sys.path.insert(0, str(tree))
    entered = Entered(tree / PACKAGE)
    with tempfile.TemporaryDirectory() as scratch:
        run(entered, CALLS[options.call](Path(scratch)))
    functions = entered.functions()
    print(f"{len(functions)} files entered by calls, {len(entered.called)} functions")
    print(f"{len(entered.imported)} files executed at import")
    if options.verbose:
        for file, count in sorted(functions.items()):
            print(f"  {count:4} {file}")


def compress(folder: Path) -> list[str]:
    """Compress seven nodes."""
    model, frames = folder / "m.onnx", folder / "frames"
    seven_nodes.write_model(model)
    seven_nodes.write_frames(frames)
    words = [
        "compress",
        model,
        "-r",
        "full",
        "--target",
        "tensorrt",
        "--frames",
        frames,
    ]
    return [*map(str, words), "-o", str(folder / "o.onnx")]


def evaluate(folder: Path) -> list[str]:
    """Drive one route: in this process, as a worker would in its own."""
    from me2e_compress.driving.policies import Driver
    from me2e_compress.evaluators.contract import Drive, Driven
    from me2e_compress.evaluators.highway import runner
    from me2e_compress.evaluators.highway.engine import LocalEngine
    from me2e_compress.simulator.routes import Route

    def here(
        self: LocalEngine, policy: Driver, drive: Drive, routes: Sequence[Route]
    ) -> Iterator[Driven]:
        for route in routes:
            yield Driven(runner.drive(route, policy.open(), drive), 0.0, 0)

    LocalEngine.drive = here  # type: ignore[method-assign]
    return ["evaluate", "highway", "--routes", "1", "-o", str(folder / "driven")]


CALLS: Mapping[str, Callable[[Path], list[str]]] = {
    "compress": compress,
    "evaluate": evaluate,
}


def run(entered: Entered, words: Sequence[str]) -> None:
    """Run a command line; what it prints is shown only where it fails."""
    sys.argv = ["me2e-compress", *words]
    said, code = io.StringIO(), 1

    def called() -> None:
        nonlocal code
        code = command()

    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        entered.during(called)
    if code:
        sys.exit(said.getvalue())


def command() -> int:
    """Run ``me2e-compress`` as its entry point does, its import with it."""
    from me2e_compress.cli import main as run_command

    return run_command()


if __name__ == "__main__":
    main()
