"""How large the package is, held against its budget: `house.toml`.

    python -m benchmarks.house [--entered]

Prints lines by room, options, circles of files and files with one reader, each beside
its budget; ``--entered`` runs three calls and counts the files and functions that they
enter (a minute). Raising a budget is a line of `house.toml` that a reviewer sees.
"""

import argparse
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grimp

from benchmarks.files_entered import CALLS
from me2e_compress.cli.app import COMMANDS

ROOT = Path(__file__).parents[1]
PACKAGE = "me2e_compress"


@dataclass(frozen=True)
class House:
    """What was counted.

    Attributes:
        lines: of Python, by room; files beside the rooms are ``.``.
        options: of all commands.
        circles: imports within a room that lead back, ``FILE -> FILE``.
    """

    lines: Mapping[str, int]
    options: int
    circles: frozenset[str]

    @property
    def total(self) -> int:
        """Lines of all rooms."""
        return sum(self.lines.values())


def measure(root: Path = ROOT) -> House:
    """Count everything that needs no run."""
    graph = grimp.build_graph(PACKAGE, cache_dir=None)
    return House(
        lines_by_room(root / PACKAGE),
        sum(1 for _ in options()),
        frozenset(circles(graph)),
    )


def lines_by_room(package: Path) -> dict[str, int]:
    """Count lines of Python, room by room."""
    found = Counter[str]()
    for path in package.rglob("*.py"):
        room = path.relative_to(package).parent.parts[:1]
        found[room[0] if room else "."] += path.read_bytes().count(b"\n")
    return dict(found)


def options() -> Iterator[str]:
    """List the options of all commands."""
    for name, entry in COMMANDS.items():
        for parameter in entry.load().params:
            if parameter.param_type_name == "option":
                yield f"{name} {parameter.opts[0]}"


def circles(graph: grimp.ImportGraph) -> Iterator[str]:
    """List the imports within a room through which a file imports itself."""
    for module in graph.modules:
        for imported in graph.find_modules_directly_imported_by(module):
            same = module.split(".")[:2] == imported.split(".")[:2]
            if same and graph.chain_exists(importer=imported, imported=module):
                yield f"{_short(module)} -> {_short(imported)}"


def entered(call: str) -> tuple[int, int]:
    """Return files and functions that a call enters, measured in a fresh process."""
    words = [sys.executable, "-m", "benchmarks.files_entered", "--call", call]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    files, functions = done.stdout.splitlines()[0].split(" files entered by calls, ")
    return int(files), int(functions.split()[0])


def budget(path: Path = ROOT / "house.toml") -> dict[str, Any]:
    """Read what is allowed.

    Raises:
        ValueError: a room is not there.
    """
    found = tomllib.loads(path.read_text(encoding="utf-8"))
    rooms = {each.name for each in (ROOT / PACKAGE).iterdir() if each.is_dir()} | {"."}
    if unknown := found["lines"].keys() - rooms:
        raise ValueError(f"{path.name}: no room {', '.join(sorted(unknown))}")
    return found


def _short(module: str) -> str:
    return module.removeprefix(f"{PACKAGE}.").replace(".", "/") + ".py"


def main() -> None:
    """Print what there is beside what is allowed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--entered", action="store_true")
    asked = parser.parse_args()
    house, allowed = measure(), budget()
    lines, entries = allowed["lines"], allowed["entered"]
    for room, count in sorted(house.lines.items(), key=lambda each: -each[1]):
        print(f"{count:7,} of {lines.get(room, 0):7,}  {room}")
    print(f"{house.total:7,} of {allowed['total']:7,}  in all")
    print(f"{house.options:7,} of {allowed['options']:7,}  options")
    print(f"circles: {', '.join(sorted(house.circles)) or 'none'}")
    for call in CALLS if asked.entered else ():
        files, functions = entered(call)
        print(f"{call}: {files} files, {functions} functions of {entries[call]}")


if __name__ == "__main__":
    main()
