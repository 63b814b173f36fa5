"""Workers run no code of the current folder, and nobody asks the network."""

import subprocess
import sys
from pathlib import Path

import pytest

import me2e_compress

OURS = str(Path(me2e_compress.__file__).parents[1])
TRAP = """
from pathlib import Path
Path(__file__).with_suffix(".sprung").touch()
raise SystemExit("trapped")
"""
TRAPS = ("me2e_compress", "json", "numpy", "pickle", "multiprocessing", "onnxruntime")
WATCH = """
import sys
from pathlib import Path

def watch(event, given):
    if event in ("socket.connect", "socket.getaddrinfo", "socket.sendto"):
        if not isinstance(given[1], (bytes, str)) or event == "socket.getaddrinfo":
            with Path({!r}).open("a") as file:
                file.write(f"{{event}} {{given!r}}\\n")

sys.addaudithook(watch)
"""
START = "import sys; from me2e_compress.cli import main; sys.exit(main())"
WORDS = ("evaluate", "blind", "-o", "out", "--routes", "2", "--workers", "2")


@pytest.mark.slow
def test_workers_import_nothing_from_here_and_ask_nobody(tmp_path: Path) -> None:
    here, site = tmp_path / "here", tmp_path / "site"
    here.mkdir()
    site.mkdir()
    for name in TRAPS:
        (here / f"{name}.py").write_text(TRAP)
    (site / "sitecustomize.py").write_text(WATCH.format(str(tmp_path / "asked")))

    done = subprocess.run(
        [sys.executable, "-P", "-c", START, *WORDS],
        cwd=here,
        env={"HOME": str(tmp_path), "PYTHONPATH": f"{site}:{OURS}"},
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    assert list(here.glob("*.sprung")) == []
    assert not (tmp_path / "asked").exists(), (tmp_path / "asked").read_text()
