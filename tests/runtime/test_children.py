"""One family of processes for all: a trap as the current folder, an empty home."""

import json
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest

import me2e_compress

SCRIPT = """
import json, os, signal, sys, time
from pathlib import Path
from me2e_compress.runtime import children
from models.processes import process_pool

def look():
    import numpy
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    return os.getpid(), signal.SIGINT in blocked

def stay():
    time.sleep(600)

if __name__ == "__main__":
    import onnxruntime
    place = Path(sys.argv[1])
    said = children.run_script(place / "printer.py", ["word"])
    with process_pool(1) as processes:
        worker, is_deaf = processes.submit(look).result()
        processes.submit(stay)
        print(json.dumps({"worker": worker, "deaf": is_deaf, "said": said.stdout}))
        sys.stdout.flush()
        time.sleep(600)
"""
PRINTER = "import sys, numpy, json; print(sys.argv[1], sys.flags.safe_path)"
TRAP = """
from pathlib import Path
Path(__file__).with_suffix(".sprung").touch()
raise SystemExit("trapped")
"""
TRAPS = ("json", "numpy", "pickle", "random", "threading")


@dataclass(frozen=True)
class Family:
    """What a parent, killed by now, and its children left.

    Attributes:
        said: by the parent.
        alive: processes that outlive it.
        home: the folder that was its empty home.
        folder: the trap that it worked in.
    """

    said: dict[str, Any]
    alive: list[psutil.Process]
    home: Path
    folder: Path


@pytest.fixture(scope="module")
def family(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Family]:
    place = tmp_path_factory.mktemp("family")
    home, folder = place / "home", place / "trap"
    home.mkdir()
    folder.mkdir()
    for name in TRAPS:
        (folder / f"{name}.py").write_text(TRAP)
    scripts = {"parent": SCRIPT, "printer": PRINTER}
    for name, text in scripts.items():
        (place / f"{name}.py").write_text(textwrap.dedent(text))
    ours = str(Path(me2e_compress.__file__).parents[1])
    parent = subprocess.Popen(
        [sys.executable, str(place / "parent.py"), str(place)],
        cwd=folder,
        env={"HOME": str(home), "PYTHONPATH": ours},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    line = parent.stdout.readline()
    relatives = psutil.Process(parent.pid).children(recursive=True)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    _, alive = psutil.wait_procs(relatives, timeout=20)
    yield Family(json.loads(line), alive, home, folder)
    for each in alive:
        each.kill()


def test_children_are_apart_from_folder_home_and_ctrl_c_and_end_with_their_parent(
    family: Family,
) -> None:
    assert list(family.folder.glob("*.sprung")) == []
    assert family.said["said"] == "word True\n"
    assert list(family.home.rglob("*")) == []
    assert family.said["deaf"]
    assert family.alive == []
