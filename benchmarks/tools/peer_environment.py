"""An interpreter of its own for the peers that this package must not depend on."""

import subprocess
import sys
from pathlib import Path

PINS = ("openvino==2026.4.1", "nncf==3.4.0", "numpy==2.4.6")
"""OpenVINO, its own quantization, and what both and our tools read arrays with."""


def peer_python(folder: Path) -> Path:
    """Return the interpreter of a virtual environment with `PINS`, made if need be.

    Raises:
        subprocess.CalledProcessError: It cannot be made, e.g. without a registry.
    """
    python, made = folder / "bin" / "python", folder / "pins.txt"
    text = "\n".join(PINS)
    if made.is_file() and made.read_text("utf-8") == text:
        return python
    subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
    install = [str(python), "-m", "pip", "install", "--quiet", *PINS]
    subprocess.run(install, check=True, stdout=sys.stderr)
    made.write_text(text, "utf-8")
    return python


def peer_versions(python: Path) -> str:
    """Say what an interpreter has of the peers; empty where it has none."""
    names = [pin.partition("=")[0] for pin in PINS]
    ask = (
        "from importlib.metadata import distributions\n"
        f"have = [d for d in distributions() if d.name in {names}]\n"
        "print(*sorted(f'{d.name} {d.version}' for d in have), sep=', ')"
    )
    done = subprocess.run(
        [python, "-c", ask], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()
