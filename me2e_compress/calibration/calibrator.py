"""Calibrate a graph in one streaming pass, in the memory of inference."""

import dataclasses
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress import graph
from me2e_compress.base import documents
from me2e_compress.base.atomic import write_bytes
from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.calibration.dataset import CalibrationSet, load_arrays, npz_bytes
from me2e_compress.calibration.observers import DEFAULT_METHOD, OBSERVERS
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.statistics import (
    NOT_FINITE,
    READINGS,
    Floats,
    Probe,
    Reading,
    Statistics,
    check_finite,
    checksum,
    exponents_of,
    first_bad_node,
    index_inputs,
    insert_probes,
    is_not_finite,
    rebinned,
    shared_constant,
)
from me2e_compress.graph.nodes import makers_of, reads_of
from me2e_compress.operators import OWN_DOMAIN
from me2e_compress.operators.kernels.kernel import BINS
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.runnable import why_unsupported
from me2e_compress.runtime.session import DTYPES, Session, feed_forward


@dataclasses.dataclass(frozen=True)
class Extremes:
    """Smallest element, largest element, mean square.

    A tensor without elements gives infinity, minus infinity and 0.
    """

    width: int = 3

    def read(self, where: ir.Graph, value: ir.Value, at: int) -> Reading:
        """Build three reductions of the whole tensor."""
        one = shared_constant(where, np.array([1], np.int64), "one")
        least = shared_constant(where, np.array(1, np.float32), "least")
        # The mean square shows where few elements determine the range. It also finds
        # every NaN, which onnxruntime's ReduceMin and ReduceMax overlook unless it
        # comes first
        low, high, total = (
            ir.node(op, [value], {"keepdims": 0})
            for op in ("ReduceMin", "ReduceMax", "ReduceSumSquare")
        )
        # Divide by at least 1: a tensor may be empty.
        size = ir.node("Size", [value])
        count = _cast(size.outputs[0], ir.DataType.FLOAT)
        some = ir.node("Max", [count.outputs[0], least])
        mean = ir.node("Div", [total.outputs[0], some.outputs[0]])
        # All readings are 1-D, so that they can be joined.
        flat = [
            ir.node("Reshape", [node.outputs[0], one]) for node in (low, high, mean)
        ]
        nodes = [low, high, total, size, count, some, mean, *flat]
        return nodes, [node.outputs[0] for node in flat]


@dataclasses.dataclass(frozen=True)
class ExtremesAndCounts:
    """Extremes, and a histogram (:mod:`me2e_compress.operators.histogram`).

    The bins of one frame fit into those of another (`rebinned`).
    """

    width: int = 3 + BINS

    def read(self, where: ir.Graph, value: ir.Value, at: int) -> Reading:
        """Build the extremes, and a node that counts in between."""
        nodes, readings = Extremes().read(where, value, at)
        row = shared_constant(where, np.array([-1], np.int64), "row")
        flat = ir.node("Reshape", [value, row])
        inputs = [flat.outputs[0], nodes[0].outputs[0], nodes[1].outputs[0]]
        for tensor, dims in zip(inputs, ([None], [], []), strict=True):
            tensor.dtype, tensor.shape = ir.DataType.FLOAT, ir.Shape(dims)
        count = ir.node("Histogram", inputs, domain=OWN_DOMAIN)
        return [*nodes, flat, count], [*readings, count.outputs[0]]


def _cast(value: ir.Value, to: ir.DataType) -> ir.Node:
    return ir.node("Cast", [value], {"to": to.value})


# Checkpoints of a long calibration, so that it can resume after a kill.


_STATE = "state/"

Arrays: TypeAlias = dict[str, Array]


@dataclasses.dataclass(frozen=True)
class CalibrationCheckpoint:
    """The file of a calibration's progress; a path of None keeps nothing.

    ``key`` identifies the calibration: digest of the graph, tensors, frames, ...
    """

    path: Path | None
    key: Mapping[str, object]

    def read(self) -> tuple[int, Arrays, Arrays]:
        """Read frames done, results so far, and the state for the next frame."""
        if self.path is None or not self.path.is_file():
            return 0, {}, {}
        try:
            arrays = load_arrays(self.path, "a checkpoint")
            key = documents.from_json(str(arrays.pop("key")))
            done = int(str(arrays.pop("done")))
        except (ValueError, KeyError) as error:
            raise FramesError(f"{self.path}: not a checkpoint ({error})") from error
        # A checkpoint of another calibration is refused.
        wanted = json.loads(json.dumps(self.key))
        if not isinstance(key, dict) or key.keys() != wanted.keys():
            raise FramesError(
                f"{self.path}: a checkpoint of another version; remove it"
            )
        if stale := [name for name in wanted if key[name] != wanted[name]]:
            raise FramesError(
                f"{self.path}: stale: a checkpoint of another {stale[0]}; remove it to"
                " begin again"
            )
        # The state shares the archive, under a prefix
        states = [name for name in arrays if name.startswith(_STATE)]
        state = {name.removeprefix(_STATE): arrays.pop(name) for name in states}
        return done, arrays, state

    def write(
        self, done: int, results: Mapping[str, Array], state: Mapping[str, Array]
    ) -> None:
        """Write frames done, results so far, and the state atomically."""
        if self.path is None:
            return
        head = {"key": np.array(json.dumps(self.key)), "done": np.array(done)}
        states = {_STATE + name: array for name, array in state.items()}
        write_bytes(self.path, npz_bytes({**head, **results, **states}))


Progress: TypeAlias = Callable[[int, int], None]


@dataclasses.dataclass(frozen=True)
class Calibrator:
    """Measure the ranges of tensors.

    Attributes:
        method: how statistics become ranges, see
            :data:`me2e_compress.calibration.observers.OBSERVERS`.
        threads: threads within an operator; 0 takes every core.
        optimize: False runs the nodes as written: the ranges then equal, bit for bit,
            those of tools that disable onnxruntime's optimizations.
        checkpoint: file of the progress, from which a calibration resumes; it is
            removed at the end. None keeps none.
        every: frames between two checkpoints.
    """

    method: str = DEFAULT_METHOD
    threads: int = 0
    optimize: bool = True
    checkpoint: Path | None = None
    every: int = 8
    provider: Provider = CPU

    def run(
        self,
        model: ir.Model,
        tensors: Sequence[str],
        frames: CalibrationSet,
        progress: Progress | None = None,
    ) -> Ranges:
        """Collect statistics and compute ranges; see :meth:`collect`."""
        return Ranges.of(
            self.collect(model, tensors, frames, progress), OBSERVERS.parse(self.method)
        )

    def collect(
        self,
        model: ir.Model,
        tensors: Sequence[str],
        frames: CalibrationSet,
        progress: Progress | None = None,
    ) -> Statistics:
        """Run the model over the frames, its recurrent state fed forward.

        ``progress`` is called with frames done and all frames.

        Raises:
            FramesError: there are no frames; one does not fit, or makes a tensor NaN or
                infinite; the checkpoint is of another calibration.
            GraphError: onnxruntime cannot run the graph.
            RecipeError: no such method.
        """
        counting = OBSERVERS.parse(self.method).counts
        if not len(frames):
            raise FramesError("no frames to calibrate on")
        empty = Statistics(
            graph.digest(model),
            frames.fingerprint,
            tuple(tensors),
            tuple(frames.places),
            np.empty((0, len(tensors), Extremes().width), np.float32),
            inputs=_numeric_names(model.graph.inputs),
            outputs=_numeric_names(model.graph.outputs),
            scenes=tuple(frames.places[at] for at in frames.scenes),
        )
        # Without tensors to measure, nothing is run.
        if not tensors:
            unread = np.empty((len(frames), 0, Extremes().width), np.float32)
            return dataclasses.replace(empty, measured=unread, inputs=(), outputs=())
        if reason := why_unsupported(model, self.provider):
            raise GraphError(
                f"{reason}; ranges that TensorRT measured are taken by `calibrate"
                " --import CACHE`, and then by `compress --ranges`"
            )
        job = _Job(self, model, empty, frames, progress, counting)
        job.run()
        if self.checkpoint is not None:
            self.checkpoint.unlink(missing_ok=True)
        return job.statistics


class _Job:
    """One running calibration."""

    def __init__(
        self,
        settings: Calibrator,
        model: ir.Model,
        blank: Statistics,
        frames: CalibrationSet,
        progress: Progress | None,
        counting: bool,
    ) -> None:
        self.settings = settings
        self.model = model
        self.frames = frames
        self.progress = progress
        self.probe: Probe = ExtremesAndCounts() if counting else Extremes()
        # A checkpoint is valid only for the same calibration.
        key = {
            "model": blank.model,
            "recording": blank.source,
            "choice of frames": list(blank.frames),
            "list of tensors": list(blank.tensors),
            "list of inputs and outputs": [*blank.inputs, *blank.outputs],
            "optimization level": settings.optimize,
            "provider": settings.provider.name,
            "kind of statistics": "both" if counting else "extremes",
        }
        self.checkpoint = CalibrationCheckpoint(settings.checkpoint, key)
        self.done, results, self.state = self.checkpoint.read()
        known = set(blank.tensors)
        self.places = [name for name in index_inputs(model) if name not in known]
        # Continue from the checkpoint, if there is one
        measured = results.get("measured", blank.measured)
        blank_counts = np.zeros((len(blank.tensors), BINS), np.int64)
        counts = results.get("counts", blank_counts if counting else None)
        ports = len(blank.inputs) + len(blank.outputs)
        checksums = results.get("checksums", np.empty((0, ports)))
        self.statistics = dataclasses.replace(
            blank,
            measured=np.asarray(measured, np.float32),
            checksums=np.asarray(checksums, np.int64),
            counts=None if counts is None else np.asarray(counts, np.int64),
            not_finite=str(results.get("not_finite", "")),
        )

    def run(self) -> None:
        """Measure every tensor on the frames that are not done yet."""
        rows, sums = list(self.statistics.measured), self.statistics.checksums.tolist()
        ports = (*self.statistics.inputs, *self.statistics.outputs)
        for readings, arrays, place in self._frames():
            # Refuse what has no range, and name the node that made it
            sums.append([checksum(arrays[name]) for name in ports])
            extremes, cause = readings[:, :3], self.statistics.not_finite
            if not cause and (is_not_finite(extremes).any() or NOT_FINITE in sums[-1]):
                tensors_read = {
                    *self.statistics.tensors,
                    *self.places,
                    *self.statistics.outputs,
                }
                provider = self.settings.provider
                cause = first_bad_node(
                    self.model, arrays, tensors_read, Extremes(), provider
                )
            watched = extremes[: len(self.statistics.tensors)]
            check_finite(watched, self.statistics.tensors, place, cause)
            rows.append(watched)
            after = dataclasses.replace(
                self.statistics,
                measured=np.stack(rows),
                checksums=np.array(sums, np.int64),
                not_finite=cause,
            )
            # Bring both histograms to the bins of the larger reach
            if self.statistics.counts is not None:
                frame = readings[: len(watched), 3:].astype(np.int64)
                counts = rebinned(frame, after.exponents - exponents_of(watched))
                counts += rebinned(
                    self.statistics.counts, after.exponents - self.statistics.exponents
                )
                after = dataclasses.replace(after, counts=counts)
            self.statistics = after

    def _frames(self) -> Iterator[tuple[Floats, Mapping[str, Array], int]]:
        """Run the frames that are left, and store the progress from time to time.

        Yields the readings of each frame, float32 [tensors and places, width of the
        probe], its inputs and outputs, and its index.
        """
        begin = self.done
        if begin >= len(self.frames):
            return
        session = probed_session(
            self.model,
            (*self.statistics.tensors, *self.places),
            self.probe,
            threads=self.settings.threads,
            optimize=self.settings.optimize,
            provider=self.settings.provider,
        )
        state = self.state if begin else None
        floats = [name for name, port in session.outputs.items() if port.type in DTYPES]
        rest = (self.frames[index] for index in range(begin, len(self.frames)))
        runs = feed_forward(session, rest, floats, state)
        for done, (inputs, values, after) in enumerate(runs, begin + 1):
            readings = values[READINGS].astype(np.float32)
            place = self.statistics.frames[done - 1]
            yield readings.reshape(-1, self.probe.width), {**inputs, **values}, place
            last = done == len(self.frames)
            if self.settings.checkpoint and (done % self.settings.every == 0 or last):
                results: dict[str, Array] = {
                    "measured": self.statistics.measured,
                    "checksums": self.statistics.checksums,
                    "not_finite": np.array(self.statistics.not_finite),
                }
                if self.statistics.counts is not None:
                    results["counts"] = self.statistics.counts
                self.checkpoint.write(done, results, after)
            if self.progress:
                self.progress(done, len(self.frames))


def _numeric_names(values: Iterable[ir.Value]) -> tuple[str, ...]:
    """Return the names of inputs or outputs of a type that numpy has."""
    numbers = [
        value
        for value in values
        if not value.is_initializer()
        and isinstance(value.type, ir.TensorType)
        and value.type.dtype.numpy() in DTYPES.values()
    ]
    return tuple(str(value.name) for value in numbers)


def probed_session(
    model: ir.Model,
    tensors: Sequence[str],
    probe: Probe,
    *,
    threads: int,
    optimize: bool,
    provider: Provider = CPU,
) -> Session:
    """Open a model with probes, in the memory and nearly the time of the model."""
    probed = insert_probes(model, tensors, probe)
    run = partial(Session, threads=threads, frugal=True, provider=provider)
    # A provider that compiles parts of the graph uses an order of its own
    if not optimize or provider.native != CPU.native:
        return run(probed, optimize=optimize)
    # Write the optimized graph with its probes, put its nodes into an order in which
    # every watched tensor is freed as early as without them, and run it as it is
    with tempfile.TemporaryDirectory(prefix="me2e-probed-") as folder:
        path = Path(folder) / "optimized.onnx"
        Session(probed, threads=1, rewritten=path, provider=provider)
        rewritten = ir.load(path)
        common.NameFixPass()(rewritten)  # its fusions give one name to two values
        schedule_probes(rewritten)
        scheduled = path.with_name("scheduled.onnx")
        ir.save(rewritten, scheduled)
        return run(scheduled, optimize=False)


def schedule_probes(model: ir.Model) -> None:
    """Move the nodes of every probe to the earliest position, in place."""
    # onnxruntime runs nodes in the order of the file (`Session(frugal=True)`), and its
    # optimizations append new nodes at the end: the conversion from a blocked layout
    # that a probe reads would come last, and keep the tensors of a backbone in memory.
    # What the model's own outputs need keeps its order; the rest waits for its inputs
    nodes = list(model.graph)
    own = makers_of([v for v in model.graph.outputs if v.name != READINGS])
    waiting = {
        node: {
            v for v in reads_of(node) if v.producer() is not None or v.is_graph_input()
        }
        for node in nodes
        if node not in own
    }
    order: list[ir.Node] = []

    def ready(value: ir.Value) -> Iterator[ir.Node]:
        for node in dict.fromkeys(value.consumers()):
            if node in waiting and value in waiting[node]:
                waiting[node].discard(value)
                if not waiting[node]:
                    yield node

    def place(first: Sequence[ir.Node]) -> None:
        pending = list(reversed(first))
        while pending:
            node = pending.pop()
            order.append(node)
            pending += [reader for out in node.outputs for reader in ready(out)]

    # Place nodes without inputs, readers of inputs, then the rest.
    place([node for node in waiting if not waiting[node]])
    for value in model.graph.inputs:
        place(list(ready(value)))
    for node in nodes:
        if node in own:
            place([node])
    placed = set(order)
    order += [node for node in nodes if node not in placed]
    model.graph.remove(nodes)
    model.graph.extend(order)
