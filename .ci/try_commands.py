"""Try every command in its simplest real use, with what this environment has installed.

    PYTHON .ci/try_commands.py [--works NAME,NAME,...] [--without NAME,NAME,...]

A command works, or it ends with exit code 1 and one line that says why. Anything else
is a failure, and so is a command of --works that does not work.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import onnx
import onnx.parser

from me2e_compress.cli.app import COMMANDS
from me2e_compress.shipped.drivers import WEIGHTS

FRAMES = str(WEIGHTS / "highway-frames")
ROUTE = {
    "route_id": "RouteScenario_1711_rep0",
    "scenario_name": "ParkingCutIn_1",
    "status": "Completed",
    "infractions": {"min_speed_infractions": ["Average speed is 90.0% of the rest"]},
    "scores": {"score_route": 100, "score_penalty": 1.0, "score_composed": 100.0},
    "meta": {"route_length": 133.1, "duration_game": 18.7, "duration_system": 23.0},
}
RUN = {"_checkpoint": {"records": [ROUTE], "progress": [1, 1]}, "eligible": True}
STUDY = """
title = "the driver that ships"
baseline = "float"
routes = "1"
[[variant]]
name = "float"
policy = "highway"
[[condition]]
name = "ideal"
latency = "none"
"""
USES = (
    "doctor",
    "list",
    "export highway -o copy.onnx",
    "inspect highway",
    "frames highway -n 4 -o frames",
    "plan highway --scheme full",
    f"calibrate highway {FRAMES} -o ranges.json",
    f"compress highway -r feature-ext --frames {FRAMES} -o small.onnx",
    "lint small.onnx",
    f"sensitivity highway {FRAMES} -o sensitive.toml",
    f"search highway {FRAMES} --max-mb 5 -o found.toml",
    f"compare highway small.onnx {FRAMES}",
    f"profile highway {FRAMES} -o trace.json --samples 20",
    "evaluate highway --routes 1 -o driven",
    "evaluate small.onnx --check",
    "score real",
    "study study.toml -o study",
    "demo -o out",
    "join stack.toml -o one.onnx",
    "split one.onnx stack.toml -o files",
)
PARTS = {"body": ("x", "features"), "head": ("features", "plan")}
"""Files of a stack, each one Relu: what it reads and what it gives."""


def main() -> int:
    """Try what was asked for; return 1 if anything but that happened."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--works", default="", help="these commands have to work")
    parser.add_argument("--without", default="", help="these commands are not tried")
    asked = parser.parse_args()
    must, left_out = asked.works.split(","), asked.without.split(",")
    if untried := COMMANDS.keys() - {use.split()[0] for use in USES}:
        raise SystemExit(f"commands without a use: {', '.join(sorted(untried))}")
    failed = False
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "study.toml").write_text(STUDY)
        write_stack(Path(folder))
        real = Path(folder) / "real"
        real.mkdir()
        (real / "run.json").write_text(json.dumps(RUN))
        for use in USES:
            name = use.split()[0]
            if name not in left_out:
                works, said = attempt(use.split(), folder)
                failed |= works is None or (name in must and not works)
                sys.stdout.write(f"{said}\n")
                sys.stdout.flush()
    return int(failed)


def write_stack(folder: Path) -> None:
    """Write a stack of two files, and the TOML that names them."""
    for name, (read, given) in PARTS.items():
        text = f'<ir_version: 9, opset_import: ["" : 17]> {name} (float[1,4] {read})'
        text += f" => (float[1,4] {given}) {{ {given} = Relu({read}) }}"
        onnx.save(onnx.parser.parse_model(text), folder / f"{name}.onnx")
    tables = (f'[[part]]\nname = "{name}"\nfile = "{name}.onnx"\n' for name in PARTS)
    (folder / "stack.toml").write_text("".join(tables))


def attempt(words: list[str], folder: str) -> tuple[bool | None, str]:
    """Run a command; return whether it works, and what to say; None is a failure."""
    begun = time.perf_counter()
    command = [sys.executable, "-m", "me2e_compress", *words]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    took = f"{time.perf_counter() - begun:5.1f} s"
    use = " ".join(words).replace(FRAMES, "FRAMES")
    told = done.stderr.splitlines()
    if done.returncode == 0 and "Traceback" not in done.stderr:
        lines = done.stdout.splitlines() or told or [""]
        return True, f"works     {took}  {use}\n    {lines[0]}\n    {lines[-1]}"
    if done.returncode == 1 and len(told) == 1:
        return False, f"one line  {took}  {use}\n    {told[0]}"
    return None, f"FAILED    {took}  {use}: {done.returncode}\n{done.stderr}"


if __name__ == "__main__":
    sys.exit(main())
