"""Which method reads int8 ranges best, and how far recordings differ.

    python -m benchmarks.measure.observers outliers OUT
    python -m benchmarks.measure.observers scenes RECORDINGS

``outliers`` gives TCP and VAD-tiny of models/, whose weights are random, outliers of
trained size, and prints the SQNR of every output on held-out frames under each method.
``scenes`` prints how far ranges of the driver differ between recordings, and between a
few scenes and all: the sources of two constants of ``calibration/ranges.py``.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.statistics import Statistics
from me2e_compress.fidelity.compare import OutputFidelity, Reference
from me2e_compress.graph import rewrite
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.nodes import array_of, sole_reader
from me2e_compress.passes.base import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.session import Session

FloatArray: TypeAlias = npt.NDArray[np.float32]
METHODS = ("max-min", "percentile", "mse")
SIZE = np.float32(32)
"""How much larger an outlier channel is: position embeddings of PETR reach 130 where
the image features that they are added to reach 4 (Q-PETR, arXiv 2502.15488), channels
in front of a LayerNorm up to 40 times the median (FQ-ViT, arXiv 2111.13824). A power of
two changes no digit of the float graph."""
CHANNELS = 256
"""One channel in so many is an outlier, at least one: BERT has 2 of 768 (Bondarenko et
al., EMNLP 2021)."""
SEED = 0
FRAMES = {"tcp": (64, 16), "vad-tiny": (8, 4)}
"""Frames to calibrate on (seed 0) and held out (seed 1), in scenes of four."""
LIMIT_DB = 3.0
_PASS_ON = ("Relu", "LeakyRelu", "MaxPool", "AveragePool", "GlobalAveragePool")
"""Operators that scale a channel of their output as one of their input is scaled."""


@dataclasses.dataclass(frozen=True)
class Weight:
    """A constant, and the axis of the channels in it."""

    value: ir.Value
    axis: int

    @property
    def channels(self) -> int:
        array = array_of(self.value)
        return 0 if array is None else array.shape[self.axis]

    def scale(self, channels: Sequence[int], factor: np.float32) -> None:
        array = np.array(array_of(self.value))
        moved = np.moveaxis(array, self.axis, 0)
        moved[list(channels)] *= factor
        self.value.const_value = ir.tensor(array, name=self.value.name)


@dataclasses.dataclass(frozen=True)
class Tensor:
    """What lies between two layers: its writers' weights, and its reader's."""

    channels: int
    writers: tuple[Weight, ...]
    reader: Weight


def tensors_between(model: ir.Model) -> Iterator[Tensor]:
    """Find the tensors that one layer writes and only another layer reads."""
    for node in model.graph:
        written = _weight(node, out=True)
        if written is None:
            continue
        bias = node.inputs[2] if len(node.inputs) > 2 else None
        writers = [written, *([] if bias is None else [Weight(bias, 0)])]
        value = node.outputs[0]
        reader = sole_reader(value)
        while reader is not None:
            read = _weight(reader, out=False)
            if read is not None and reader.inputs[0] is value:
                shared = any(len(each.value.uses()) > 1 for each in (*writers, read))
                if not shared:
                    yield Tensor(written.channels, tuple(writers), read)
                break
            row = None if node.op_type == "Conv" else _row_of(reader, value)
            if row is not None:
                writers.append(row)
            elif reader.op_type not in _PASS_ON:
                break
            value = reader.outputs[0]
            reader = sole_reader(value)


def _weight(node: ir.Node, *, out: bool) -> Weight | None:
    """Return the weight of a layer, with the axis of its output or input channels."""
    if node.op_type not in ("Conv", "Gemm", "MatMul") or node.inputs[1] is None:
        return None
    array = array_of(node.inputs[1])
    turned = node.op_type == "Conv" or node.attributes.get_int("transB", 0) == 1
    if array is None or array.dtype != np.float32:
        return None
    if node.op_type == "Conv" and node.attributes.get_int("group", 1) != 1:
        return None
    if node.op_type != "Conv" and array.ndim != 2:
        return None
    return Weight(node.inputs[1], 0 if turned == out else 1)


def _row_of(node: ir.Node, value: ir.Value) -> Weight | None:
    """Return the bias that an Add gives to a value, one number a channel."""
    others = [each for each in node.inputs if each is not value]
    if node.op_type != "Add" or len(others) != 1 or others[0] is None:
        return None
    array = array_of(others[0])
    return None if array is None or array.ndim != 1 else Weight(others[0], 0)


def give_outliers(model: ir.Model) -> int:
    """Scale channels up where they are written, down where they are read, in place."""
    generator = np.random.default_rng(SEED)
    count = 0
    for each in list(tensors_between(model)):
        few = max(1, each.channels // CHANNELS)
        drawn = generator.choice(each.channels, few, replace=False).tolist()
        for weight in each.writers:
            weight.scale(drawn, SIZE)
        each.reader.scale(drawn, 1 / SIZE)
        count += 1
    return count


def outliers(out: Path) -> None:
    """Measure both stacks, without outliers and with them."""
    for name in FRAMES:
        model, frames, held_out, modules = _subject(name, out)
        plain = Reference.of(Session(model), held_out)
        changed = model.clone()
        count = give_outliers(changed)
        with_them = Reference.of(Session(changed), held_out)
        same = min(each.sqnr_db for each in plain.compare(with_them.session).outputs)
        print(f"{name}: {count} tensors with outliers, float the same to {same:.0f} dB")
        for title, graph_, reference in (
            ("with outliers", changed, with_them),
            ("without outliers", model, plain),
        ):
            losses(f"{name}, {title}", graph_, frames, modules, reference)


def losses(
    title: str,
    model: ir.Model,
    frames: CalibrationSet,
    modules: ModuleMap,
    reference: Reference,
) -> None:
    """Print the SQNR of every output under each method."""
    step = QuantizeInt8(target="tensorrt")
    tensors = step.ranged_tensors(model, Context(modules))
    seen = Calibrator("mse").collect(model, tensors, frames)
    print(f"\n{title}: {len(tensors)} tensors, crest factors {_crests(seen)}\n")
    found = dict[str, Sequence[OutputFidelity]]()
    for method in METHODS:
        ranges = Ranges.of(seen, OBSERVERS.parse(method))
        context = Context(modules, frames, measured={step.name: ranges})
        made = dataclasses.replace(step, method=method).run(model.clone(), context)
        found[method] = reference.compare(Session(made.model)).outputs
    print(f"output | {' | '.join(METHODS)}\n---|{'---:|' * len(METHODS)}")
    for at, first in enumerate(found["max-min"]):
        if first.discrete:
            continue
        decibels = [found[method][at].sqnr_db for method in METHODS]
        cells = [f"{d:.1f}{'*' * (first.sqnr_db - d > LIMIT_DB)}" for d in decibels]
        print(f"{first.name} | {' | '.join(cells)}", flush=True)


def _subject(
    name: str, out: Path
) -> tuple[ir.Model, CalibrationSet, CalibrationSet, ModuleMap]:
    from benchmarks.subjects.subjects import make, write_frames
    from me2e_compress.commands.checks import load_map

    calibrated, held_out = FRAMES[name]
    subject = make(name, out, calibrated)
    folder = subject.folder / f"held-out-{held_out}"
    if not folder.is_dir():
        write_frames(name, folder, held_out, 1)
    model = graph.load(subject.model)
    rewrite.lift_constants(model)
    graph.infer_shapes(model)
    modules = load_map(subject.map, model)
    return model, CalibrationSet(subject.frames), CalibrationSet(folder), modules


def _crests(seen: Statistics) -> str:
    root = np.sqrt(seen.mean_squares.astype(np.float64).mean(axis=0))
    crest = (seen.reach / np.where(root > 0, root, np.inf))[root > 0]
    half, most = np.quantile(crest, [0.5, 1])
    return f"{half:.1f} (median) to {most:.0f}"


def scenes(folder: Path) -> None:
    """Compare the ranges of recordings, and of a few scenes with those of all."""
    from me2e_compress.commands.checks import model_path
    from me2e_compress.commands.plan import PreparedGraph

    path = model_path("highway")
    ready = PreparedGraph.of(path, graph.load(path), None)
    tensors, recordings = ready.tensors(), list[Statistics]()
    for seed in (10, 11, 12):
        frames = CalibrationSet(folder / f"frames-{seed}")
        recordings.append(Calibrator().collect(ready.model, tensors, frames))
    for a, b in itertools.combinations(recordings, 2):
        both = (a.reach > 0) & (b.reach > 0)
        ratio = np.log(a.reach[both] / b.reach[both])
        print(f"two recordings: at most {np.exp(np.abs(ratio).max()):.2f} apart")
    for few in (1, 2, 4, 8):
        missed = np.concatenate([_missed(each, few) for each in recordings])
        print(f"{few} scenes: {np.mean(missed > 0.2):.1%} miss a fifth of the range")


def _missed(seen: Statistics, few: int) -> FloatArray:
    """Return the share of each tensor's range that 50 draws of scenes miss."""
    cuts = np.searchsorted(seen.frames, seen.scenes[1:])
    reach = np.stack(
        [
            np.abs(each[..., :2]).max(axis=(0, 2))
            for each in np.split(seen.readings, cuts)
        ]
    )
    generator = np.random.default_rng(SEED)
    whole = reach.max(axis=0)
    drawn = [generator.choice(len(reach), few, replace=False) for _ in range(50)]
    return np.stack([1 - (reach[each].max(0) / whole)[whole > 0] for each in drawn])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    kinds = parser.add_subparsers(required=True)
    first = kinds.add_parser("outliers")
    second = kinds.add_parser("scenes")
    first.add_argument("out", type=Path)
    second.add_argument("folder", type=Path)
    for each, run in ((first, outliers), (second, scenes)):
        each.set_defaults(run=run)
    chosen = vars(parser.parse_args())
    run = chosen.pop("run")
    run(**chosen)


if __name__ == "__main__":
    main()
