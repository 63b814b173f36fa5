"""Change one place of a room at a time, and see whether the room's tests notice.

    python -m benchmarks.tools.mutate ROOM --seed S [--count 20] [--limit SECONDS]

ROOM is a folder of the package that has one of its name in tests/: metrics, passes,
targets/tensorrt, ... Changes are drawn from all that `benchmarks.tools.mutations` finds
in its modules, so that a seed draws the same ones as long as these stay as they are.
Works in a copy of the checkout, in a temporary folder, one change at a time: tests that
name the module go first, and the first failure ends them. Without --limit they may take
three times as long as without a change.

What survives is a hole in the tests, or means the same in another way: look.
"""

import argparse
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from benchmarks.tools.mutations import Mutation, mutations

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "me2e_compress"
_LEFT = (".git", ".venv", ".hypothesis", "__pycache__", ".*_cache", "out")
_NO_TESTS = 5
"""What pytest ends with where it collects none."""


class Fate(StrEnum):
    """What the tests make of a change."""

    KILLED = "killed"
    SURVIVED = "survived"
    TIMED_OUT = "timed out"


@dataclass(frozen=True)
class Room:
    """A folder of modules and the folder of their tests, in a copy of a checkout.

    Attributes:
        root: of the copy.
        modules: the modules' folder, relative.
        tests: the tests' folder, relative.
    """

    root: Path
    modules: Path
    tests: Path

    def draw(self, count: int, seed: int) -> list[Mutation]:
        """Draw so many changes of its modules, in the order of files and lines."""
        found = [
            each
            for file in sorted((self.root / self.modules).rglob("*.py"))
            for each in mutations(file.relative_to(self.root), file.read_bytes())
        ]
        drawn = random.Random(seed).sample(range(len(found)), min(count, len(found)))
        return [found[index] for index in sorted(drawn)]

    def fate(self, mutation: Mutation, limit_s: float) -> Fate:
        """Change a file, run the tests, and change it back."""
        file = self.root / mutation.file
        word = file.parent.name if file.stem == "__init__" else file.stem
        source = file.read_bytes()
        file.write_bytes(mutation.applied(source))
        try:
            passed = self.passes(limit_s, word)
        except subprocess.TimeoutExpired:
            return Fate.TIMED_OUT
        finally:
            file.write_bytes(source)
        return Fate.SURVIVED if passed else Fate.KILLED

    def passes(self, limit_s: float, first: str = "") -> bool:
        """Run the tests up to the first that fails; those that name a word go first.

        Raises:
            SystemExit: There are no tests.
            subprocess.TimeoutExpired: They take longer; what they started is gone.
        """
        files = sorted((self.root / self.tests).rglob("test_*.py"))
        if not files:
            raise SystemExit(f"{self.tests}: no tests")
        files.sort(key=lambda file: first not in file.read_text())  # a stable order
        # a file changed twice within a second would be taken for its first bytecode
        bytecode = {"PYTHONDONTWRITEBYTECODE": "1"} if first else {}
        environment = {"PYTHONPATH": str(self.root), "OMP_NUM_THREADS": "1", **bytecode}
        code = run(
            [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
            + [str(file) for file in files],
            self.root,
            limit_s,
            environment,
        )
        if code == _NO_TESTS:
            raise SystemExit(f"{self.tests}: no tests")
        return code == 0


def run(
    words: Sequence[str], folder: Path, limit_s: float, more: dict[str, str]
) -> int:
    """Run a command in a folder, all it starts with it; return its exit code.

    Raises:
        subprocess.TimeoutExpired: It took longer, and was killed.
    """
    with subprocess.Popen(
        words,
        cwd=folder,
        env={**os.environ, **more},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
        try:
            return process.wait(limit_s)
        finally:  # also what a killed test has left behind
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def fates(
    room: Room, count: int, seed: int, limit_s: float | None
) -> Iterator[tuple[Mutation, Fate]]:
    """Give every drawn change and what became of it, one by one.

    Raises:
        SystemExit: The tests fail without any change.
    """
    begun = time.monotonic()
    if not room.passes(limit_s or 3600.0):
        raise SystemExit(f"{room.tests}: fails without any change")
    limit_s = limit_s or 10.0 + 3 * (time.monotonic() - begun)
    for mutation in room.draw(count, seed):
        yield mutation, room.fate(mutation, limit_s)


def table(found: Sequence[tuple[Mutation, Fate]]) -> Iterator[str]:
    """Write what survived and what took too long, then how many of each there are."""
    for fate in (Fate.SURVIVED, Fate.TIMED_OUT):
        yield from (f"{fate:<9}  {each}" for each, met in found if met is fate)
    met = Counter(fate for _, fate in found)
    numbers = ", ".join(f"{fate} {met[fate]}" for fate in Fate)
    share = 100 * met[Fate.KILLED] / max(len(found), 1)
    yield f"{len(found)} changes: {numbers}; {share:.0f} % killed"


def main(words: Sequence[str] | None = None, root: Path = ROOT) -> None:
    """Copy a checkout, and change a room of the copy."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("room", help="folder of the package and of tests/")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--limit", type=float, help="seconds for one run of the tests")
    parser.add_argument("--package", default=PACKAGE)
    given = parser.parse_args(words)
    with tempfile.TemporaryDirectory(prefix="mutate-") as folder:
        copy = Path(folder) / "checkout"
        shutil.copytree(
            root, copy, symlinks=True, ignore=shutil.ignore_patterns(*_LEFT)
        )
        room = Room(copy, Path(given.package, given.room), Path("tests", given.room))
        found = []
        for mutation, fate in fates(room, given.count, given.seed, given.limit):
            print(f"{fate:<9}  {mutation}", flush=True)
            found.append((mutation, fate))
    print(f"\n{given.room}, seed {given.seed}", *table(found), sep="\n")


if __name__ == "__main__":
    main()
