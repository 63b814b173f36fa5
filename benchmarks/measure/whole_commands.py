"""Exact passes as a whole command beside onnxsim and onnxslim: CPU time and memory.

    python -m benchmarks.measure.whole_commands MODEL.onnx FRAMES --map MAP -o OUT/

Ours is ``compress -r exact`` with its verification on two frames and an empty cache, as
on the first day. Each tool runs once in a process of its own; CPU seconds and the
largest resident memory are those of the process and of all that it starts.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import onnx

INTERVAL_S = 0.1
"""Between two looks at the memory."""

SIMPLIFY = (
    "import onnx, onnxsim, sys;"
    " onnx.save(onnxsim.simplify(sys.argv[1])[0], sys.argv[2])"
)


def resident_mb(process: int) -> float:
    """Add up the resident memory of a process and of its children, MB."""
    total, ahead = 0, [process]
    while ahead:
        folder = Path("/proc", str(ahead.pop()))
        try:
            lines = (folder / "status").read_text("utf-8").splitlines()
            total += sum(int(x.split()[1]) for x in lines if x.startswith("VmRSS"))
            for task in (folder / "task").iterdir():
                ahead += map(int, (task / "children").read_text("utf-8").split())
        except OSError:  # it has ended
            continue
    return total / 1024


def cpu_s() -> float:
    """Return the CPU seconds of all children that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def measured(command: list[str]) -> tuple[float, float]:
    """Run a command; return its CPU seconds and its largest memory, MB."""
    before, peak = cpu_s(), 0.0
    with tempfile.TemporaryDirectory() as cache:
        process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "XDG_CACHE_HOME": cache},
        )
        while process.poll() is None:
            peak = max(peak, resident_mb(process.pid))
            time.sleep(INTERVAL_S)
    return cpu_s() - before, peak


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("frames", type=Path)
    parser.add_argument("--map", required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    model, python = str(given.model), sys.executable
    ours = ["-m", "me2e_compress", "compress", model, "-r", "exact", "--force"]
    ours += ["--frames", str(given.frames), "--map", given.map, "-o"]
    tools = {
        "ours, verified": [python, *ours],
        "onnxsim": [python, "-c", SIMPLIFY, model],
        "onnxslim": [python, "-m", "onnxslim", model],
    }
    for name, command in tools.items():
        path = given.out / f"{name.partition(',')[0]}.onnx"
        seconds, peak = measured([*command, str(path)])
        if not path.is_file():
            print(f"{name}: wrote nothing")
            continue
        nodes = onnx.load(path, load_external_data=False).graph.node
        count = sum(node.op_type != "Constant" for node in nodes)
        share = path.stat().st_size / given.model.stat().st_size
        print(
            f"{name}: {seconds:.1f} CPU s, {peak:,.0f} MB; {count:,} nodes,"
            f" {path.stat().st_size / 1e6:.1f} MB, {share:.3f} of the model",
            flush=True,
        )


if __name__ == "__main__":
    main()
