"""What :mod:`benchmarks.measure.runtime` runs: files of a model, ours and others'.

A file that is there is not made again.
"""

import dataclasses
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.subjects.subject import Subject
from benchmarks.tools.processes import last_line
from me2e_compress import graph

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


PLANS = {
    "vad-tiny": "ego_fut_preds",
    "vad-tiny-original": "ego_fut_preds",
    "uniad-tiny": "sdc_traj",
    "tcp": "pred_wp",
    "deformable-detr": "",
}
"""The models that are measured, and which output of each is the plan."""
FOLDED = "import-normalize,fold-constants"
BEFORE = f"{FOLDED},eliminate-redundant,hoist-linear,flatten-matmul"
FUSED = f"{BEFORE},fuse-operators,eliminate-redundant,fuse-basic"
INT8 = "quantize-int8{target=onnxruntime}"
KERNELS = "fuse-kernels"
QUANTIZED = Entry("onnxruntime", "onnxruntime-int8", tool="peer", of="model")
ENTRIES = {
    "PyTorch, eager": Entry("torch", "stack"),
    "PyTorch, torch.compile": Entry("torch-compile", "stack"),
    REFERENCE: Entry("onnxruntime", "source"),
    "onnxsim + onnxruntime": Entry("onnxruntime", "onnxsim", tool="onnxsim"),
    "onnxruntime.quantization": QUANTIZED,
    "OpenVINO, float32": Entry("openvino-f32", "source"),
    "OpenVINO, bfloat16": Entry("openvino-bf16", "source"),
    "OpenVINO, int8": dataclasses.replace(QUANTIZED, engine="openvino-f32"),
    "ours, exact": Entry("ours", "exact", f"{BEFORE},fuse-basic"),
    "ours, fused": Entry("ours", "fused", f"{FUSED},{KERNELS}"),
    "ours, int8": Entry("ours", "int8", f"{BEFORE},fuse-basic,{INT8}"),
    "ours, int8 fused": Entry("ours", "int8-fused", f"{FUSED},{INT8},{KERNELS}"),
}
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
    return subject.folder / f"{entry.file}.onnx"


def made(subject: Subject, entry: Entry, frames: int) -> str | None:
    """Write the file of an entry, unless it is there; return why that failed."""
    path, source = path_of(subject, entry), subject.folder / f"{entry.of}.onnx"
    if entry.engine in TORCH or path.is_file():
        return None
    if entry.tool and not source.is_file():
        folded = static(ENTRIES)[REFERENCE]
        if reason := made(subject, folded, frames):
            return reason
    if entry.passes:
        command = ["-m", "me2e_compress", "compress", str(subject.source), "--passes"]
        command += [entry.passes, "--frames", str(subject.frames), "-o", str(path)]
        command += ["--map", str(subject.map), "--verify-frames", "0"]
        command += ["--measure-frames", "0"]
    elif entry.tool == "onnxsim":
        write = (
            "import onnx, onnxsim, sys; onnx.save(onnxsim.simplify(sys.argv[1])[0],"
            " sys.argv[2])"
        )
        command = ["-c", write, str(source), str(path)]
    else:
        command = ["benchmarks/tools/peer.py", "onnxruntime-uint8-tensor", str(source)]
        command += [str(subject.frames), str(path), "--frames", str(frames)]
    done = subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, check=False
    )
    return None if path.is_file() else last_line(done)


def first_frame(subject: Subject) -> Path:
    """Write the frame that all run: recorded, its state at zeros."""
    path = subject.folder / "one-frame.npz"
    if not path.is_file():
        with np.load(next(iter(sorted(subject.held_out.glob("*.npz"))))) as held:
            arrays = dict(held)
        for value in graph.load(subject.source).graph.inputs:
            shape = graph.static_shape(value) or ()
            kind = np.float32 if value.dtype is None else value.dtype.numpy()
            arrays.setdefault(str(value.name), np.zeros(shape, kind))
        np.savez(path, **arrays)
    return path
