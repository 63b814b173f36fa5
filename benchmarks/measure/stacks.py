"""Whole stacks through ``full-fused`` for both targets, with ten seeds of frames.

    python -m benchmarks.measure.stacks OUT [--stacks tcp,highway] [--seeds 10]
        [--targets onnxruntime,tensorrt] [--frames 6]

Each run exports its stack, records its frames and compresses in processes of their
own with an empty cache, as on the first day. One line of JSON a run is appended to
OUT/records.jsonl; runs that are there already are skipped, so that the command may be
stopped at any time and started again; OUT=benchmarks/records/stacks holds the runs
so far. At the end, or with ``--table`` at once, a table:
worst is the noisiest output of all seeds (matched agents where an output is a set).
Below it stand the outputs that one target keeps 6 dB better than the other.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any

from benchmarks.measure.whole_commands import cpu_s
from benchmarks.subjects.subjects import PRESETS
from me2e_compress.shipped.drivers import SHIPPED

STACKS = ("tcp", "highway", "vad-tiny", "uniad-tiny")
TARGETS = ("onnxruntime", "tensorrt")
PARTED_DB = 6.0
"""Unsigned integers have half the step of signed ones behind a ReLU: 6 dB."""
Record = Mapping[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("out", type=Path)
    add("--stacks", default=",".join(STACKS))
    add("--targets", default=",".join(TARGETS))
    add("--seeds", type=int, default=10)
    add("--frames", type=int, default=6)
    add("--table", action="store_true", help="only print the table")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path: Path = given.out / "records.jsonl"
    stacks: list[str] = given.stacks.split(",")
    targets: list[str] = given.targets.split(",")

    seeds = range(0 if given.table else given.seeds)
    for seed, stack, target in product(seeds, stacks, targets):
        key = (stack, target, seed)
        if key in {key_of(record) for record in records(path)}:
            continue
        result = run_stack(stack, target, seed, given.frames)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(result) + "\n")
        print(" ".join(map(str, key)), result["exit"], result["last"], flush=True)
    print_table(records(path))
    print_parted(records(path))


def records(path: Path) -> list[Record]:
    """Read what was measured; a line that a kill cut short is left out."""

    def lines() -> Iterator[Record]:
        for line in path.read_text("utf-8").splitlines() if path.exists() else ():
            try:
                yield json.loads(line)
            except json.JSONDecodeError:
                continue

    return list(lines())


def key_of(record: Record) -> tuple[str, str, int]:
    return record["stack"], record["target"], record["seed"]


def run_stack(stack: str, target: str, seed: int, frames: int) -> dict[str, Any]:
    """Export, record and compress in a fresh folder; return one record."""
    result: dict[str, Any] = {"stack": stack, "target": target, "seed": seed}
    result["commit"] = commit()
    with tempfile.TemporaryDirectory(prefix="me2e-stacks-") as name:
        folder = Path(name)
        model, small = folder / "model.onnx", folder / "small.onnx"
        report = folder / "small.report.json"
        export, record = made_by(stack)
        recording = ["-n", str(frames), "--seed", str(seed), "--scene-length", "4"]
        prepared = [
            [*export, stack, "-o", str(model)],
            [*record, stack, "-o", str(folder / "frames"), *recording],
        ]
        for words in prepared:
            done = run_command(words, folder)
            if done.returncode:
                return result | ended(done)
        words = ["me2e_compress", "compress", str(model), "-r", "full-fused"]
        words += ["--map", PRESETS[stack], "--target", target, "-o", str(small)]
        before = cpu_s()
        done = run_command([*words, "--frames", str(folder / "frames")], folder)
        result |= ended(done) | {"cpu_s": round(cpu_s() - before, 1)}
        result["mb_before"] = round(model.stat().st_size / 1e6, 2)
        if small.exists():
            result["mb_after"] = round(small.stat().st_size / 1e6, 2)
            result |= loss(json.loads(report.read_text("utf-8")))
    return result


def commit() -> str:
    """Return the commit that is measured, with a mark where the checkout differs."""
    words = ["git", "describe", "--always", "--dirty"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def made_by(stack: str) -> tuple[list[str], list[str]]:
    """Return the modules and commands that export a stack and record its frames."""
    if stack in SHIPPED:
        return ["me2e_compress", "export"], ["me2e_compress", "frames"]
    return ["models.export"], ["models.frames"]


def run_command(words: list[str], folder: Path) -> "subprocess.CompletedProcess[str]":
    """Run a module with an empty cache of its own."""
    return subprocess.run(
        [sys.executable, "-m", *words],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "XDG_CACHE_HOME": str(folder / "cache")},
    )


def ended(done: "subprocess.CompletedProcess[str]") -> dict[str, Any]:
    """Return how a command ended, and its last line: of its errors, if it failed."""
    text = done.stderr if done.returncode else done.stdout
    lines = text.strip().splitlines() or [""]
    return {"exit": done.returncode, "last": lines[-1]}


def loss(report: Record) -> dict[str, Any]:
    """Return the noisiest output that the report tells, its dB, and the verdict."""
    measured = report["fidelity"] or {}
    matched = (measured.get("agents") or {}).get("sqnr_db", {})
    decibels = {
        each["name"]: matched.get(each["name"], each["sqnr_db"])
        for each in (measured.get("fidelity") or {}).get("outputs", ())
        if not each["discrete"]
    }
    numbers = {name: db for name, db in decibels.items() if db is not None}
    worst = min(numbers, key=numbers.__getitem__, default="")
    told = {"worst": worst, "worst_db": numbers.get(worst), "sqnr_db": numbers}
    return told | {"verdict": report["verdict"]}


def print_table(measured: list[Record]) -> None:
    print("stack | target | runs | failed | MB | % | worst dB, least to most | CPU s")
    print("---|---|---|---|---|---|---|---")
    for stack, target in dict.fromkeys((x["stack"], x["target"]) for x in measured):
        rows = [x for x in measured if (x["stack"], x["target"]) == (stack, target)]
        fine = [x for x in rows if x["exit"] == 0]
        cells: list[object] = [stack, target, len(rows), len(rows) - len(fine)]
        if fine:
            sizes = [x["mb_after"] for x in fine]
            share = 100 * max(sizes) / fine[0]["mb_before"]
            by_loss = sorted(fine, key=lambda x: x["worst_db"] or 0.0)
            seconds = [x["cpu_s"] for x in fine]
            cells += [
                f"{fine[0]['mb_before']} to {max(sizes)}",
                f"{share:.1f}",
                f"{by_loss[0]['worst_db'] or 0:.1f} ({by_loss[0]['worst']}) to "
                f"{by_loss[-1]['worst_db'] or 0:.1f}",
                f"{min(seconds):.0f} to {max(seconds):.0f}",
            ]
        print(" | ".join(map(str, cells)))


def print_parted(measured: list[Record]) -> None:
    """List the outputs that one target keeps PARTED_DB better than the other."""
    told = {key_of(each): each.get("sqnr_db", {}) for each in measured}
    for (stack, target, seed), here in told.items():
        there = told.get((stack, TARGETS[1], seed), {}) if target == TARGETS[0] else {}
        for name in here.keys() & there.keys():
            if abs(here[name] - there[name]) > PARTED_DB:
                print(
                    f"{stack}, seed {seed}: placed for {TARGETS[0]}, {name} keeps"
                    f" {here[name]:.1f} dB; as placed for {TARGETS[1]}"
                    f" {there[name]:.1f} dB"
                )


if __name__ == "__main__":
    main()
