"""Which faults of a host does ``compare --outputs`` name, and where does it cry wolf?

    python -m benchmarks.bench_engine_faults OUT [--stack highway] [--frames 16]
        [--scene 4] [--recipe full] [--only state-late,bgr]

Dumps are written by onnxruntime. The engine is the stack's graph (``--recipe``: what
that recipe makes of it) with its float weights rounded to float16, run with all
optimizations; a host with a seeded fault feeds it and reads its outputs. Each fault is
written here anew, without the code that explains it. ``--alarms`` runs the recipes of
the driver without any fault instead: rounded weights (float16, bfloat16), rounded
outputs, and noise of 50 dB on them.
"""

import argparse
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any, TypeAlias

import ml_dtypes
import numpy as np
import onnx_ir as ir

from me2e_compress.calibration.archives import archive_of
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.manager import recipe
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session
from me2e_compress.workflows.compare_dump import DumpResult, compare_dump
from me2e_compress.workflows.compress import CompressOptions, compress
from me2e_compress.workflows.export import export_stack
from me2e_compress.workflows.frames import FramesOptions, record_frames

Arrays: TypeAlias = dict[str, Any]
Change: TypeAlias = Callable[[Any], Any]
OF_OTHERS = ("uniad-", "vad-")
MIRRORED = (0, 2, 1, 3, 5, 4)
"""Left and right cameras exchanged."""
MIXED = (2, 0, 1, 5, 3, 4)
NOISE_DB = 50.0
STATISTICS = {
    "highway": ((110.0,) * 3, (60.0,) * 3),
    "vad-tiny": ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
}
SLOT_AXIS = {"highway": 1, "vad-tiny": 2}
HEAD = "fault | named | from dB | to dB | inferences | CPU s"


@dataclass(frozen=True)
class Host:
    """A host with one fault, or none.

    Attributes:
        names: Kinds of faults that name it rightly, the first of them as it is meant.
        feed: What becomes of the inputs of a frame, given all frames and its index.
        state: The state of a frame, given the first one, whether a scene starts, and
            the states after all frames before.
        read: What becomes of the outputs, as they are dumped.
        order: Which frame's answers are dumped under a frame.
    """

    names: tuple[str, ...]
    feed: Callable[[Sequence[Frame], int], Arrays] = lambda frames, at: (
        frames[at].arrays
    )
    state: Callable[[Arrays, bool, list[Arrays]], Arrays] = (
        lambda first, starts, before: first if starts else before[-1]
    )
    read: Callable[[Arrays], Arrays] = lambda outputs: outputs
    order: Callable[[int], list[int]] = lambda count: list(range(count))


def changed(name: str, change: Change) -> Any:
    def feed(frames: Sequence[Frame], at: int) -> Arrays:
        arrays = frames[at].arrays
        value = arrays[name]
        return arrays | {name: np.ascontiguousarray(change(value)).astype(value.dtype)}

    return feed


def from_other(name: str | None, other: Callable[[int], int]) -> Any:
    def feed(frames: Sequence[Frame], at: int) -> Arrays:
        found = frames[max(0, min(other(at), len(frames) - 1))].arrays
        mine = frames[at].arrays
        return dict(found) if name is None else mine | {name: found[name]}

    return feed


def reading(name: str, change: Change) -> Any:
    return lambda outputs: outputs | {name: change(outputs[name])}


def late(first: Arrays, starts: bool, before: list[Arrays]) -> Arrays:
    return first if starts or len(before) < 2 else before[-2]


def carried(first: Arrays, starts: bool, before: list[Arrays]) -> Arrays:
    return before[-1] if before else first


def never(first: Arrays, starts: bool, before: list[Arrays]) -> Arrays:
    return first


def one_never(name: str) -> Any:
    return lambda first, starts, before: (
        first if starts else before[-1] | {name: first[name]}
    )


def hosts(stack: str) -> dict[str, Host]:
    """Return the seeded faults by name."""
    on_vad = stack != "highway"
    image = "img"
    mean, std = (
        np.array(each, np.float32).reshape(3, 1, 1) for each in STATISTICS[stack]
    )
    large = "bev_embed" if on_vad else "occupancy"
    small = "ego_fut_preds" if on_vad else "plan"
    slots = "all_bbox_preds" if on_vad else "boxes"
    motion = "can_bus"
    geometry = "lidar2img"

    def shuffled(value: Any) -> Any:
        axis = SLOT_AXIS[stack]
        order = np.random.default_rng(3).permutation(value.shape[axis])
        return np.take(value, order, axis=axis)

    def channels_last(value: Any) -> Any:
        return np.moveaxis(value, 1, -1).copy()

    def blue_first(value: Any) -> Any:
        return ((value * std + mean)[:, :, ::-1] - mean) / std

    def half_filled(value: Any) -> Any:
        halves = np.resize(value.astype(np.float16), 2 * value.size)
        return halves.view(np.float32).reshape(value.shape)

    def as_text(count: int) -> list[int]:
        straight = list(range(count))
        return sorted(straight, key=str) if count > 10 else straight[::-1]

    return {
        "none": Host(("",)),
        "state carried over scenes": Host(("state-not-reset",), state=carried),
        "state one frame stale": Host(("state-late",), state=late),
        "state never fed": Host(("state-never-fed",), state=never),
        "images of 0 to 1": Host(
            ("normalisation",),
            changed(image, lambda x: ((x * std + mean) / 255 - mean) / std),
        ),
        "images not normalised": Host(
            ("normalisation",), changed(image, lambda x: x * std + mean)
        ),
        "mean missing": Host(
            ("normalisation",), changed(image, lambda x: x + mean / std)
        ),
        "red and blue swapped": Host(("colours",), changed(image, blue_first)),
        "channels last": Host(
            ("input-layout",),
            changed(image, lambda x: np.moveaxis(x, 2, -1).copy().reshape(x.shape)),
        ),
        "left and right cameras": Host(
            ("cameras",), changed(image, lambda x: x[:, list(MIRRORED)])
        ),
        "cameras mixed": Host(
            ("cameras",), changed(image, lambda x: x[:, list(MIXED)])
        ),
        "matrices transposed": Host(
            ("input-layout",), changed(geometry, lambda x: x.swapaxes(-1, -2))
        ),
        "ego status stuck": Host(("input-stuck",), from_other(motion, lambda at: 0)),
        "command stuck": Host(("input-stuck",), from_other("command", lambda at: 0)),
        "images one frame late": Host(
            ("input-late",), from_other(image, lambda at: at - 1)
        ),
        "ego status never fed": Host(
            ("input-never-fed",), changed(motion, np.zeros_like)
        ),
        "frames shifted by one": Host(
            ("frames-shifted",), from_other(None, lambda at: at - 1)
        ),
        "frames sorted as text": Host(("frame-order",), order=as_text),
        "float32 read as int32": Host(
            ("dtype",), read=reading(small, lambda x: x.view(np.int32))
        ),
        "float16 read as float32": Host(
            ("dtype",),
            read=reading(large, half_filled),
        ),
        "big endian": Host(("dtype",), read=reading(small, lambda x: x.byteswap())),
        "output channels last": Host(("layout",), read=reading(large, channels_last)),
        "output transposed, shape kept": Host(
            ("layout",),
            read=reading(large, lambda x: channels_last(x).reshape(x.shape)),
        ),
        "output flat": Host(("layout",), read=reading(small, lambda x: x.reshape(-1))),
        "slots in another order": Host(("slots",), read=reading(slots, shuffled)),
        "output scaled": Host(("scale",), read=reading(large, lambda x: x * 0.5)),
    }


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
    options = parser.parse_args(argv)
    out: Path = options.out / options.stack
    out.mkdir(parents=True, exist_ok=True)
    source = out / f"{options.stack}.onnx"
    if not source.is_file():
        export_stack(options.stack, source)
    seen, held_out = out / "seen", out / "frames"
    for folder, seed in ((seen, 0), (held_out, 5)):
        if not folder.is_dir():
            given = FramesOptions(options.frames, seed, options.scene)
            record_frames(options.stack, folder, given)
    recording = CalibrationSet(held_out)
    if options.alarms:
        return alarms(source, seen, recording, out, options.only)
    model = made(source, options.recipe, seen, out) if options.recipe else source
    return faults(model, recording, out, options)


if __name__ == "__main__":
    main()
