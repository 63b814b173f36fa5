"""Every file that the commands write, as a manifest of digests: did a change move one?

    python -m benchmarks.tools.written_files make FOLDER MANIFEST.json
        [--tree CHECKOUT] [--stacks STACKS]
    python -m benchmarks.tools.written_files compare BEFORE.json AFTER.json

``make`` runs `RUNS` in a new FOLDER, through the command line alone, so that it
measures any commit that has these options: the one it is part of, or that of another
CHECKOUT. STACKS holds graphs, each NAME.onnx beside a folder NAME of its frames
(`benchmarks.subjects.small_stacks` makes some): every one is compressed by `LOSSLESS`,
and by `RECIPES` for `TARGETS`. The manifest gives every file's SHA-256 after
`benchmarks.tools.masks`. ``compare`` lists the files that differ; exit code 1 if there
are any. Digests hold for one machine and its package versions: on another processor,
float kernels round differently.
"""

import argparse
import hashlib
import itertools
import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from benchmarks.subjects import seven_nodes
from benchmarks.tools.masks import masked, masked_name

PACKAGE = "me2e_compress"

RUNS = """
frames highway -n 4 --scene-length 2 -o frames
frames highway -n 2 --scene-length 1 --seed 1 -o held-out
compress highway -r exact --frames frames -o exact.onnx
compress highway -r feature-ext --target tensorrt --frames frames -o feature-ext.onnx
compress highway -r full --target onnxruntime --frames frames -o full.onnx
compress highway -r full-fused --target onnxruntime --frames frames -o full-fused.onnx
compress highway -r full-fused --target tensorrt --frames frames -o full-trt.onnx
compress highway -r minus-occ --frames frames -o minus-occ.onnx
compress seven.onnx -r exact -o seven.exact.onnx
compress seven.onnx -r full --target tensorrt --frames seven -o seven.full.onnx
calibrate seven.onnx seven -o seven.ranges.json --method percentile:99.9
compress seven.onnx --scheme full --target tensorrt --ranges seven.ranges.json \
--method percentile:99.9 -o seven.ranges.onnx
calibrate highway frames -o ranges.json
plan highway --scheme prediction -o prediction.plan.json
evaluate highway --routes 2 --latency trace{trace=trace.json,in_order=true} \
-o highway-in-order
evaluate highway --routes HardBreakRoute_R2_1 --render HardBreakRoute_R2_1 -o rendered
evaluate highway --routes 20 -o highway
evaluate highway --routes HazardAtSideLane_R2_0,Accident_R2_0 --latency fps:2 \
-o highway-fps
evaluate highway --routes HazardAtSideLane_R2_0,Accident_R2_0 --latency \
trace:trace.json --seed 3 --weather fog_m=80,noise=0.02,dropped=BACK -o highway-trace
score highway highway-fps highway-trace --json > scores.json
study study.toml -o study
"""
"""Command lines; what follows `>` is the file that gets the standard output."""

LOSSLESS = ("exact", "fused")
RECIPES = ("full", "full-fused")
TARGETS = ("onnxruntime", "tensorrt")

STUDY = """
title = "Written files"
baseline = "float"
routes = "HazardAtSideLane_R2_0,Accident_R2_0"
frames = "frames"
held_out = "held-out"

[[variant]]
name = "float"
policy = "highway"
trace = "trace.json"

[[variant]]
name = "full"
policy = "highway"
recipe = "full"
trace = "trace.json"

[[condition]]
name = "ideal"
latency = "none"

[[condition]]
name = "device"
latency = "trace"
"""
"""Two schemes whose latencies are given: nothing in the report is measured."""

TRACE = {
    "model_sha256": "",
    "machine": "none",
    "samples_us": [120_000, 340_000, 60_000, 180_000],
}


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make")
    making.add_argument("folder", type=Path)
    making.add_argument("manifest", type=Path)
    making.add_argument("--tree", type=Path, default=Path(__file__).parents[2])
    making.add_argument("--stacks", type=Path)
    comparing = commands.add_parser("compare")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    given = parser.parse_args(argv)
    if given.command == "compare":
        before, after = (json.loads(p.read_text()) for p in (given.before, given.after))
        return report(differences(before, after), len({*before, *after}))
    package = given.tree.resolve() / PACKAGE
    make(given.folder, package, given.stacks)
    made = manifest(given.folder, package)
    given.manifest.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    print(f"{given.manifest}: {len(made)} files")
    return 0


def make(folder: Path, package: Path, stacks: Path | None = None) -> None:
    """Write the inputs and run every command in a new folder."""
    if not package.is_dir():
        sys.exit(f"{package}: no such folder")
    folder.mkdir(parents=True)
    seven_nodes.write_model(folder / "seven.onnx")
    seven_nodes.write_frames(folder / "seven")
    (folder / "study.toml").write_text(STUDY, encoding="utf-8")
    (folder / "trace.json").write_text(json.dumps(TRACE), encoding="utf-8")
    for line in [*RUNS.strip().splitlines(), *stack_runs(stacks)]:
        run(line, folder, package)
    print(f"{cpu_s():6.1f} CPU s in all")


def stack_runs(stacks: Path | None) -> Iterator[str]:
    """Yield the command lines that compress, plan and calibrate every graph."""
    for path in sorted(stacks.glob("*.onnx")) if stacks else ():
        name, model = path.stem, path.resolve()
        frames = model.with_suffix("")
        yield f"calibrate {model} {frames} -o {name}.ranges.json"
        for target in TARGETS:
            yield f"plan {model} --target {target} -o {name}.{target}.plan.json"
        placed = [f"{r} --target {t}" for r, t in itertools.product(RECIPES, TARGETS)]
        for words in (*LOSSLESS, *placed):  # a lossless recipe has no target
            output = f"{name}.{words.replace(' --target ', '.')}.onnx"
            yield f"compress {model} -r {words} --frames {frames} -o {output}"


def run(line: str, folder: Path, package: Path) -> None:
    """Run one command line in a process of its own; end if it fails."""
    begun = cpu_s()
    words, _, output = line.partition(" > ")
    done = subprocess.run(
        [sys.executable, "-m", PACKAGE, *words.split()],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(package.parent)},
        capture_output=True,
        check=False,
    )
    if done.returncode != 0:
        sys.exit(f"{line}: exit code {done.returncode}: {done.stderr.decode()}")
    if output:
        (folder / output).write_bytes(done.stdout)
    print(f"{cpu_s() - begun:6.1f} CPU s  {line}", flush=True)


_RECORD = ".me2e-compress.json"
"""What older packages wrote beside their outputs; it holds times."""


def cpu_s() -> float:
    """Return the CPU seconds of all commands that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def manifest(folder: Path, package: Path) -> dict[str, str]:
    """Return the digest of every file below a folder, by path."""
    found = (path for path in folder.rglob("*") if path.name != _RECORD)
    files = sorted(path for path in found if path.is_file())
    names = [path.relative_to(folder).as_posix() for path in files]
    return {
        masked_name(name): hashlib.sha256(masked(folder, name, package)).hexdigest()
        for name in names
    }


def differences(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """List the files that differ, each with how."""
    found = []
    for name in sorted({*before, *after}):
        if name not in after:
            found.append(f"gone     {name}")
        elif name not in before:
            found.append(f"new      {name}")
        elif before[name] != after[name]:
            found.append(f"changed  {name}")
    return found


def report(found: Sequence[str], files: int) -> int:
    """Print what differs; return the exit code."""
    for line in found:
        print(line)
    print(f"{len(found)} of {files} files differ")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
