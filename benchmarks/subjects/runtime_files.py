"""What :mod:`benchmarks.measure.runtime` runs: files of a model, ours and others'.

A file that is there is not made again.
"""

import dataclasses
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure.whole_commands import cpu_s
from benchmarks.subjects.subject import Subject
from benchmarks.tools.processes import last_line
from me2e_compress import graph
from me2e_compress.manager import recipe
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import Session

REFERENCE = "onnxruntime, as exported"
TORCH = ("torch", "torch-compile")
"""Engines of :mod:`benchmarks.tools.run_one` that run the stack itself, without a
file."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """A row: an engine of :mod:`benchmarks.tools.run_one`, and what it runs.

    Attributes:
        engine: its name.
        file: its name in the folder; of PyTorch, which has none, a word.
        passes: of ours, what makes it of the exported file.
        tool: of others, what makes it; empty for the exported file.
        of: the file that a tool reads.
    """

    engine: str
    file: str
    passes: str = ""
    tool: str = ""
    of: str = "source"

    @property
    def peer(self) -> bool:
        """Whether it runs in the interpreter of the peers."""
        return self.engine.startswith("openvino")


PLANS = {
    "vad-tiny": "ego_fut_preds",
    "vad-tiny-original": "ego_fut_preds",
    "uniad-tiny": "sdc_traj",
    "tcp": "pred_wp",
    "lead": "pred_future_waypoints",
    "highway": "plan",
    "deformable-detr": "",
}
"""The models that are measured, and which output of each is the plan."""
WITHOUT_TORCH = ("deformable-detr", "highway")
"""Those that are no stack of models/."""
FOLDED = "import-normalize,fold-constants"
BEFORE = f"{FOLDED},eliminate-redundant,hoist-linear,flatten-matmul"
FUSED = f"{BEFORE},fuse-operators,eliminate-redundant,fuse-basic"
QUANTIZED = Entry("onnxruntime", "onnxruntime-int8", tool="peer", of="model")
PRECISIONS = {"float32": "openvino-f32", "bfloat16": "openvino-bf16"}
"""In which OpenVINO computes what is not int8, and the engine."""
TARGETS = ("onnxruntime", "tensorrt")
"""What int8 is placed for, the recipes' first."""


def in_openvino(name: str, entry: Entry) -> dict[str, Entry]:
    """Return the rows of a file in OpenVINO."""
    return {
        f"{name}, {precision}": dataclasses.replace(entry, engine=engine)
        for precision, engine in PRECISIONS.items()
    }


def peers() -> dict[str, Entry]:
    """Return the rows of others: floats, and what their own tools quantize."""
    nncf = {
        f"NNCF int8, {way}": Entry("", file, tool=file)
        for way, file in (("defaults", "nncf"), ("by hand", "nncf-by-hand"))
    }
    return {
        "PyTorch, eager": Entry("torch", "stack"),
        "PyTorch, torch.compile": Entry("torch-compile", "stack"),
        REFERENCE: Entry("onnxruntime", "source"),
        "onnxsim + onnxruntime": Entry("onnxruntime", "onnxsim", tool="onnxsim"),
        "onnxruntime.quantization": QUANTIZED,
        **in_openvino("OpenVINO", Entry("", "source")),
        "OpenVINO, int8": dataclasses.replace(QUANTIZED, engine="openvino-f32"),
        **in_openvino("NNCF int8, defaults", nncf["NNCF int8, defaults"]),
        **in_openvino("NNCF int8, by hand", nncf["NNCF int8, by hand"]),
    }


def ours() -> dict[str, Entry]:
    """Return the rows of our recipes in onnxruntime and in OpenVINO.

    Fused files hold local functions, which OpenVINO takes through our provider alone.
    """
    entries = {}
    for name in ("exact", "fused", "full", "full-fused"):
        passes = recipe.to_text(recipe.load(name))
        for target in TARGETS if name.startswith("full") else ("",):
            placed = passes.replace(f'"{TARGETS[0]}"', f'"{target}"')
            entry = Entry("ours", f"{name}-{target}".strip("-"), placed)
            row = f"ours, {name}" + (f" for {target}" if target else "")
            entries[row] = entry
            inside = dataclasses.replace(entry, engine="ours-openvino")
            openvino = f"{row}, in OpenVINO"
            fused = name.endswith("fused")
            rows = {openvino: inside} if fused else in_openvino(openvino, entry)
            entries |= rows
    return entries


ENTRIES = {**peers(), **ours()}
OPTIONAL = {"torch.compile": "PyTorch, torch.compile"}
"""Rows that only ``--with`` measures: torch.compile compiles for six minutes."""

_STATIC = "static-"
_STATIC_FOLDED = "import-normalize,freeze-inputs,fold-constants"


def static(entries: Mapping[str, Entry]) -> dict[str, Entry]:
    """Return the rows with constant camera matrices.

    What others read is the exported file after ``freeze-inputs`` and
    ``fold-constants``; PyTorch runs what it always does.
    """
    return {
        name: entry if entry.engine in TORCH else _static(entry)
        for name, entry in entries.items()
    }


def _static(entry: Entry) -> Entry:
    passes = entry.passes or ("" if entry.tool else FOLDED)
    return dataclasses.replace(
        entry,
        file=f"{_STATIC}{entry.file}",
        passes=passes.replace(FOLDED, _STATIC_FOLDED),
        of=f"{_STATIC}source",
    )


def path_of(subject: Subject, entry: Entry) -> Path:
    """Give the file that an entry runs."""
    suffix = "xml" if entry.tool.startswith("nncf") else "onnx"
    return subject.folder / f"{entry.file}.{suffix}"


def made(
    subject: Subject, entry: Entry, frames: int, python: Path | None = None
) -> str | None:
    """Write the file of an entry, unless it is there; return why that failed.

    ``python`` is the interpreter of the peers, which only NNCF needs. The CPU seconds
    that it took are kept in ``made.json``.
    """
    path, source = path_of(subject, entry), subject.folder / f"{entry.of}.onnx"
    if entry.engine in TORCH or path.is_file():
        return None
    if entry.tool and not source.is_file():
        folded = static(ENTRIES)[REFERENCE]
        if reason := made(subject, folded, frames):
            return reason
    begun = cpu_s()
    done = subprocess.run(
        _command(subject, entry, source, path, frames, python),
        capture_output=True,
        text=True,
        check=False,
    )
    if not path.is_file():
        return last_line(done)
    kept = subject.folder / "made.json"
    seconds = made_cpu_s(subject) | {path.name: round(cpu_s() - begun, 1)}
    kept.write_text(json.dumps(seconds, indent=1), "utf-8")
    return None


def made_cpu_s(subject: Subject) -> dict[str, float]:
    """Return the CPU seconds that each file took to be made, by its name."""
    kept = subject.folder / "made.json"
    found: dict[str, float] = json.loads(kept.read_text()) if kept.is_file() else {}
    return found


def _command(
    subject: Subject,
    entry: Entry,
    source: Path,
    path: Path,
    frames: int,
    python: Path | None,
) -> list[str]:
    """Return the command that writes the file of an entry."""
    if entry.passes:
        command = ["-m", "me2e_compress", "compress", str(subject.source), "--passes"]
        command += [entry.passes, "--frames", str(subject.frames), "-o", str(path)]
        command += ["--map", str(subject.map), "--verify-frames", "0"]
        command += ["--measure-frames", "0"]
    elif entry.tool.startswith("nncf"):
        command = ["-m", "benchmarks.tools.quantize_nncf", str(source)]
        command += [str(subject.frames), str(path), "--frames", str(frames)]
        command += ["--by-hand"] if entry.tool == "nncf-by-hand" else []
    elif entry.tool == "onnxsim":
        write = (
            "import onnx, onnxsim, sys; onnx.save(onnxsim.simplify(sys.argv[1])[0],"
            " sys.argv[2])"
        )
        command = ["-c", write, str(source), str(path)]
    else:
        command = ["benchmarks/tools/peer.py", "onnxruntime-uint8-tensor", str(source)]
        command += [str(subject.frames), str(path), "--frames", str(frames)]
    peer = entry.tool.startswith("nncf") and python is not None
    return [str(python) if peer else sys.executable, "-W", "ignore", *command]


def first_frame(subject: Subject) -> Path:
    """Write the frames that all run, and return the first."""
    return min(whole_frames(subject).glob("*.npz"))


def whole_frames(subject: Subject) -> Path:
    """Write the frames that all run: recorded, the first state at zeros.

    Later ones have the state that the exported file answers, the same for all rows.
    """
    folder = subject.folder / "measured"
    if folder.is_dir():
        return folder
    model = graph.load(subject.source)
    fed_by = json.loads(model.metadata_props.get("me2e.recurrent", "{}"))
    state: dict[str, Array] = {}
    for value in model.graph.inputs:
        shape = graph.static_shape(value) or ()
        kind = np.float32 if value.dtype is None else value.dtype.numpy()
        state[str(value.name)] = np.zeros(shape, kind)
    session = Session(subject.source, release=True) if fed_by else None
    folder.mkdir()
    for path in sorted(subject.held_out.glob("*.npz")):
        with np.load(path) as held:
            arrays: dict[str, Any] = state | dict(held)
        np.savez(folder / path.name, **arrays)
        if session is not None:
            outputs = session.run({name: arrays[name] for name in session.inputs})
            state |= {name: outputs[output] for name, output in fed_by.items()}
    return folder
