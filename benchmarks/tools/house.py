"""How large the project is, held against `house.toml`.

    python -m benchmarks.tools.house [--entered] [--write]

Prints lines by room, lines of tests, words of docs, options and circles of files, each
beside today's count and its ceiling; ``--entered`` runs two calls and counts the
files and functions that they enter (a minute). ``--write`` notes lower counts as
today's: a count may only fall, and a test holds it against the last commit's.
"""

import argparse
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grimp

from benchmarks.tools.files_entered import CALLS
from me2e_compress.cli.app import COMMANDS, options_of

ROOT = Path(__file__).parents[2]
PACKAGE = "me2e_compress"


@dataclass(frozen=True)
class House:
    """What was counted.

    Attributes:
        lines: of Python, by room; files beside the rooms are ``.``.
        options: of all commands.
        tests: lines of Python below ``tests``.
        words: of the pages below ``docs``.
        circles: imports within a room that lead back, ``FILE -> FILE``.
    """

    lines: Mapping[str, int]
    options: int
    tests: int
    words: int
    circles: frozenset[str]

    @property
    def total(self) -> int:
        """Lines of all rooms."""
        return sum(self.lines.values())

    def counts(self) -> dict[str, int]:
        """Return every count by its name in `house.toml`."""
        whole = {"total": self.total, "options": self.options}
        beside = {"tests": self.tests, "words": self.words}
        return {**whole, **beside, **{f"lines.{n}": k for n, k in self.lines.items()}}


def measure(root: Path = ROOT) -> House:
    """Count everything that needs no run."""
    graph = grimp.build_graph(PACKAGE, cache_dir=None)
    return House(
        lines_by_room(root / PACKAGE),
        sum(1 for _ in options()),
        sum(lines_by_room(root / "tests").values()),
        sum(len(page.read_text("utf-8").split()) for page in pages(root)),
        frozenset(circles(graph)),
    )


def lines_by_room(package: Path) -> dict[str, int]:
    """Count lines of Python, room by room."""
    found = Counter[str]()
    for path in package.rglob("*.py"):
        room = path.relative_to(package).parent.parts[:1]
        found[room[0] if room else "."] += path.read_bytes().count(b"\n")
    return dict(found)


def pages(root: Path) -> Iterator[Path]:
    """List the pages of the docs."""
    return (root / "docs").glob("*.md")


def options() -> Iterator[str]:
    """List the options of all commands."""
    for name in COMMANDS:
        yield from (f"{name} {option}" for option in options_of(name))


def circles(graph: grimp.ImportGraph) -> Iterator[str]:
    """List the imports within a room through which a file imports itself."""
    for module in graph.modules:
        for imported in graph.find_modules_directly_imported_by(module):
            same = module.split(".")[:2] == imported.split(".")[:2]
            if same and graph.chain_exists(importer=imported, imported=module):
                yield f"{_short(module)} -> {_short(imported)}"


def entered(call: str) -> tuple[int, int]:
    """Return files and functions that a call enters, measured in a fresh process."""
    words = [sys.executable, "-m", "benchmarks.tools.files_entered", "--call", call]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    files, functions = done.stdout.splitlines()[0].split(" files entered by calls, ")
    return int(files), int(functions.split()[0])


@dataclass(frozen=True)
class Budget:
    """What `house.toml` says; names are those of `House.counts` and of calls.

    Attributes:
        ceilings: where the project goes.
        today: what it had at the last count; only ever lower than the commit before.
        ceilings_bind: whether a count above its ceiling is an error by now.
        circles: imports within a room that lead back and are to go.
    """

    ceilings: Mapping[str, Any]
    today: Mapping[str, Any]
    ceilings_bind: bool
    circles: list[str]

    @classmethod
    def parse(cls, text: str) -> "Budget":
        """Read the text of a `house.toml`."""
        document = tomllib.loads(text)
        return cls(
            _flat(document["ceilings"]),
            _flat(document["today"]),
            document["ceilings_bind"],
            document["kept"]["circles"],
        )


def budget(path: Path = ROOT / "house.toml") -> Budget:
    """Read what is allowed.

    Raises:
        ValueError: a room is not there.
    """
    budget = Budget.parse(path.read_text(encoding="utf-8"))
    rooms = {folder.name for folder in (ROOT / PACKAGE).iterdir() if folder.is_dir()}
    known = {f"lines.{room}" for room in rooms | {"."}}
    named = {name for name in budget.today if name.startswith("lines.")}
    if unknown := sorted(named - known):
        rooms_named = ", ".join(name.removeprefix("lines.") for name in unknown)
        raise ValueError(f"{path.name}: no room {rooms_named}")
    return budget


def committed_before(root: Path = ROOT) -> str | None:
    """Return the `house.toml` before this one; None outside a checkout with history.

    In a tree where the file was edited it is the last commit's, else that of the
    commit before.
    """
    text = (root / "house.toml").read_text(encoding="utf-8")
    for commit in ("HEAD", "HEAD^"):
        words = ["git", "show", f"{commit}:house.toml"]
        shown = subprocess.run(
            words, cwd=root, capture_output=True, text=True, check=False
        )
        if shown.returncode:
            return None
        if shown.stdout != text:
            return shown.stdout
    return text


def write_lower(house: House, path: Path = ROOT / "house.toml") -> None:
    """Note every count that fell as today's, in place."""
    counts, text = house.counts(), path.read_text(encoding="utf-8")
    head, _, today = text.partition("[today]")
    for name, count in counts.items():
        key = name.removeprefix("lines.")
        written = f'"{key}"' if name.startswith("lines.") else key
        match = re.search(rf"^{re.escape(written)} = (\d+)$", today, re.MULTILINE)
        if match and int(match[1]) > count:
            today = today.replace(match[0], f"{written} = {count}")
    gone = {name for name in budget(path).today if name.startswith("lines.")}
    for name in gone - counts.keys():
        today = re.sub(
            rf'^"{name.removeprefix("lines.")}" = \d+\n', "", today, flags=re.MULTILINE
        )
    path.write_text(f"{head}[today]{today}", encoding="utf-8")


def _flat(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``[lines] passes = 1`` as ``lines.passes``, other tables as they are."""
    flat: dict[str, Any] = {}
    for name, value in table.items():
        if name == "lines":
            flat |= {f"lines.{room}": count for room, count in value.items()}
        elif isinstance(value, Mapping):
            flat |= value
        else:
            flat[name] = value
    return flat


def _short(module: str) -> str:
    return module.removeprefix(f"{PACKAGE}.").replace(".", "/") + ".py"


def main() -> None:
    """Print what there is beside what is allowed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--entered", action="store_true")
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    house, allowed = measure(), budget()
    print(f"{'count':>7} {'today':>7} {'ceiling':>7}")
    for name, count in sorted(house.counts().items(), key=lambda pair: -pair[1]):
        limits = (allowed.today.get(name, 0), allowed.ceilings.get(name, 0))
        print(f"{count:7,} {limits[0]:7,} {limits[1]:7,}  {name}")
    print(f"circles: {', '.join(sorted(house.circles)) or 'none'}")
    for call in CALLS if asked.entered else ():
        files, functions = entered(call)
        print(f"{call}: {files} files, {functions} functions of {allowed.today[call]}")
    if asked.write:
        write_lower(house)


if __name__ == "__main__":
    main()
