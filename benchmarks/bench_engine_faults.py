"""Which faults of a host does ``compare --outputs`` name, and where does it cry wolf?

    python -m benchmarks.bench_engine_faults OUT [--stack highway] [--frames 16]
        [--scene 4] [--recipe full] [--only state-late,bgr] [--small]

Dumps are written by onnxruntime. The engine is the stack's graph (``--recipe``: what
that recipe makes of it) with its float weights rounded to float16, run with all
optimizations; a host with a seeded fault (:mod:`benchmarks.wrong_hosts`) feeds it and
reads its outputs. ``--alarms`` runs the recipes of
the driver without any fault instead: rounded weights (float16, bfloat16), rounded
outputs, and noise of 50 dB on them. ``--small`` takes VAD-tiny with all of its layers,
narrower and of six smaller images.
"""

import argparse
import shutil
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import ml_dtypes
import numpy as np
import onnx_ir as ir

from benchmarks.wrong_hosts import STATISTICS, Arrays, Change, Host, hosts
from me2e_compress.calibration.archives import archive_of
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.recording import Begin, write_recording
from me2e_compress.manager import recipe
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session
from me2e_compress.workflows.compare_dump import DumpResult, compare_dump
from me2e_compress.workflows.compress import CompressOptions, compress
from me2e_compress.workflows.export import export_stack
from me2e_compress.workflows.frames import FramesOptions, record_frames
from me2e_compress.zoo.synthetic_frames import frames as synthetic
from tests.zoo.vad.sizes import SIZES

SMALL = SIZES["small"]
OF_OTHERS = ("uniad-", "vad-")
NOISE_DB = 50.0
HEAD = "fault | named | from dB | to dB | inferences | CPU s"


def drive(session: Session, frames: Sequence[Frame], host: Host) -> list[Arrays]:
    """Run an engine over frames as a host with a fault does; return its dump."""
    given, before = list[Arrays](), list[Arrays]()
    first = dict(session.first_state({}))
    for at, frame in enumerate(frames):
        state = host.state(first, frame.starts_scene, before)
        found = session.run({**host.feed(frames, at), **state})
        answers = {name: np.array(each) for name, each in found.items()}
        before.append({to: answers[name] for to, name in session.recurrent.items()})
        del before[:-2]
        given.append(answers)
    return [host.read(given[at]) for at in host.order(len(given))]


def write(
    folder: Path, names: Sequence[str], dump: Sequence[Mapping[str, Array]]
) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, arrays in zip(names, dump, strict=True):
        (folder / name).write_bytes(archive_of(arrays))
    return folder


def engine_of(path: Path, kind: str) -> Session:
    """Open a graph with its float weights rounded, as a compiler may."""
    model = ir.load(path)
    for value in model.graph.initializers.values():
        tensor = value.const_value
        if tensor is not None and tensor.dtype == ir.DataType.FLOAT and tensor.size > 1:
            held = tensor.numpy().astype(getattr(ml_dtypes, kind, None) or kind)
            value.const_value = ir.tensor(held.astype(np.float32), name=value.name)
    return Session(model, threads=1, release=True)


def small_frames(given: FramesOptions, begin: Begin) -> Iterator[Frame]:
    """Yield synthetic frames of the small VAD-tiny."""
    length = given.scene_length or given.count
    drawn = synthetic(SMALL.stack, given.count, given.seed, length, begin.frame)
    for index, arrays in enumerate(drawn, begin.frame):
        yield Frame(index, index % length == 0, dict(arrays))


def judged(model: Path, dump: Path, frames: Path) -> tuple[DumpResult, float]:
    start = process_time()
    found = compare_dump(model, dump, frames)
    return found, process_time() - start


def told(name: str, found: DumpResult, seconds: float) -> str:
    faults = (
        "; ".join(f"{each.kind}: {each.said}" for each in found.faults) or "nothing"
    )
    before = min((each.before_db for each in found.faults), default=float("nan"))
    after = min((each.after_db for each in found.faults), default=float("nan"))
    return (
        f"{name} | {faults} | {before:.1f} | {after:.1f} | {found.inferences}"
        f" | {seconds:.1f}"
    )


def is_right(host: Host, found: DumpResult) -> bool:
    kinds = [each.kind for each in found.faults]
    return kinds == ([] if host.names == ("",) else [host.names[0]])


def faults(model: Path, recording: CalibrationSet, out: Path, options: Any) -> None:
    """Seed every fault, with the engine's state in the dump and without it."""
    session = engine_of(model, "float16")
    frames = list(recording)
    states = set(session.recurrent.values())
    names = [each.name for each in recording.files]
    for dumped in (True, False)[: 1 if options.stateful else 2]:
        print(f"\n{model.stem}, state {'dumped' if dumped else 'not dumped'}\n{HEAD}")
        right = total = 0
        for name, host in hosts(options.stack).items():
            if options.only and name not in options.only.split(","):
                continue
            if name == "command stuck" and "command" not in session.inputs:
                continue
            given = drive(session, frames, host)
            kept = [
                {k: v for k, v in each.items() if dumped or k not in states}
                for each in given
            ]
            folder = write(out / "dump", names, kept)
            found, seconds = judged(model, folder, recording.folder)
            total += 1
            right += (ok := is_right(host, found))
            line = told(name, found, seconds)
            print(line if ok else f"WRONG {line}", flush=True)
        print(f"{right} of {total} right")


def alarms(
    source: Path, seen: Path, recording: CalibrationSet, out: Path, only: str
) -> None:
    """Judge engines without a fault: every recipe, rounded in several ways."""
    names = [each.name for each in recording.files]
    print("recipe, engine | named | least dB | inferences")
    for name in ["source", *recipe.shipped()]:
        if name.startswith(OF_OTHERS) or (only and name not in only.split(",")):
            continue
        model = source if name == "source" else made(source, name, seen, out)
        for kind in ("float32", "float16", "bfloat16"):
            given = drive(engine_of(model, kind), list(recording), Host(("",)))
            dumps = list(_roundings(given)) if kind == "float32" else [("", given)]
            for said, dump in dumps:
                folder = write(out / "dump", names, dump)
                found, _ = judged(model, folder, recording.folder)
                least = min(each.compilation_db for each in found.outputs)
                kinds = ", ".join(each.said for each in found.faults) or "nothing"
                print(
                    f"{name}, weights {kind}{said} | {kinds} | {least:.1f}"
                    f" | {found.inferences}",
                    flush=True,
                )


def _roundings(given: list[Arrays]) -> Iterator[tuple[str, list[Arrays]]]:
    noise = np.random.default_rng(0)

    def noisy(value: Any) -> Any:
        power = np.sqrt(np.mean(np.square(value, dtype=np.float64)))
        level = power * 10 ** (-NOISE_DB / 20)
        return (value + noise.normal(0, level, value.shape)).astype(value.dtype)

    def each(change: Change) -> list[Arrays]:
        return [{name: change(value) for name, value in of.items()} for of in given]

    yield "", given
    yield ", outputs float16", each(lambda x: x.astype(np.float16).astype(x.dtype))
    yield f", noise {NOISE_DB:.0f} dB", each(noisy)


def made(source: Path, name: str, seen: Path, out: Path) -> Path:
    target = out / f"{name}.onnx"
    if not target.is_file():
        unchecked = CompressOptions(verify_frames=0, measure_frames=0)
        compress(source, target, name, seen, unchecked)
    return target


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--stack", default="highway", choices=list(STATISTICS))
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--scene", type=int, default=4)
    parser.add_argument("--recipe", default="")
    parser.add_argument("--only", default="")
    parser.add_argument(
        "--stateful", action="store_true", help="with dumped state only"
    )
    parser.add_argument("--alarms", action="store_true")
    parser.add_argument("--small", action="store_true", help="of vad-tiny")
    options = parser.parse_args(argv)
    out: Path = options.out / options.stack
    out.mkdir(parents=True, exist_ok=True)
    source = out / f"{options.stack}.onnx"
    if not source.is_file():
        if options.small:
            SMALL.export(source)
        else:
            export_stack(options.stack, source)
    seen, held_out = out / "seen", out / "frames"
    for folder, seed in ((seen, 0), (held_out, 5)):
        if folder.is_dir():
            continue
        given = FramesOptions(options.frames, seed, options.scene)
        if options.small:
            write_recording(folder, partial(small_frames, given), {"seed": seed})
        else:
            record_frames(options.stack, folder, given)
    recording = CalibrationSet(held_out)
    if options.alarms:
        return alarms(source, seen, recording, out, options.only)
    model = made(source, options.recipe, seen, out) if options.recipe else source
    return faults(model, recording, out, options)


if __name__ == "__main__":
    main()
