"""Calibrate a graph in one streaming pass, in the memory of inference."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.observers import DEFAULT_METHOD, OBSERVERS
from me2e_compress.calibration.probes import Counts, Extremes
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.resume import CalibrationCheckpoint, CalibrationState
from me2e_compress.calibration.statistics import BINS, Statistics, checksum, no_element
from me2e_compress.calibration.stream import Readings, Recording, probed_session, stream
from me2e_compress.errors import FramesError, GraphError
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.probing import Probe
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.runnable import unsupported
from me2e_compress.runtime.session import DTYPES

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
        frames: Recording,
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
        frames: Recording,
        progress: Progress | None = None,
    ) -> Statistics:
        """Run the model over the frames, its recurrent state fed forward.

        A method that needs histograms takes a second pass, because the first one finds
        their bins. ``progress`` is called with frames done and all frames, of both
        passes.

        Raises:
            FramesError: there are no frames; one does not fit, or makes a tensor NaN or
                infinite; the checkpoint is of another calibration.
            GraphError: onnxruntime cannot run the graph.
            RecipeError: no such method.
        """
        counting = OBSERVERS.parse(self.method).counts
        if not len(frames):
            raise FramesError("no frames to calibrate on")
        blank = Statistics(
            graph.digest(model),
            frames.fingerprint,
            tuple(tensors),
            tuple(frames.places),
            np.empty((0, len(tensors), Extremes().width), np.float32),
            inputs=_ports(model.graph.inputs),
            outputs=_ports(model.graph.outputs),
            scenes=tuple(frames.places[at] for at in frames.scenes),
        )
        # Without tensors to measure, nothing is run.
        if not tensors:
            nothing = np.empty((len(frames), 0, Extremes().width), np.float32)
            return dataclasses.replace(blank, measured=nothing, inputs=(), outputs=())
        if reason := unsupported(model, self.provider):
            raise GraphError(
                f"{reason}; ranges that TensorRT measured are taken by `calibrate"
                " --import CACHE`, and then by `compress --ranges`"
            )
        # Extremes first: they decide the bins of the histograms.
        job = _Job(self, model, blank, frames, progress, 2 if counting else 1)
        job.extremes()
        if counting:
            job.counts()
        job.checkpoint.clear()
        return job.seen


class _Job:
    """One running calibration."""

    def __init__(
        self,
        settings: Calibrator,
        model: ir.Model,
        blank: Statistics,
        frames: Recording,
        progress: Progress | None,
        passes: int,
    ) -> None:
        self.settings = settings
        self.model = model
        self.frames = frames
        self.progress = progress
        self.total = passes * len(frames)
        # A checkpoint is valid only for the same calibration.
        key = {
            "model": blank.model,
            "recording": blank.source,
            "choice of frames": list(blank.frames),
            "list of tensors": list(blank.tensors),
            "list of inputs and outputs": [*blank.inputs, *blank.outputs],
            "optimization level": settings.optimize,
            "provider": settings.provider.name,
            "kind of statistics": "counts" if passes == 2 else "extremes",
        }
        self.checkpoint = CalibrationCheckpoint(
            settings.checkpoint, key, settings.every
        )
        self.begun = self.checkpoint.read()
        # Continue from the checkpoint, if there is one.
        measured = self.begun.results.get("measured", blank.measured)
        counts = self.begun.results.get("counts")
        ports = len(blank.inputs) + len(blank.outputs)
        checksums = self.begun.results.get("checksums", np.empty((0, ports)))
        self.seen = dataclasses.replace(
            blank,
            measured=np.asarray(measured, np.float32),
            checksums=np.asarray(checksums, np.int64),
            counts=None if counts is None else np.array(counts, np.int64),
        )

    def extremes(self) -> None:
        """Measure minimum, maximum and mean square of every tensor and frame."""
        rows, sums = list(self.seen.measured), self.seen.checksums.tolist()
        ports = (*self.seen.inputs, *self.seen.outputs)

        def take(readings: Readings, held: Mapping[str, Array], place: int) -> None:
            check_finite(readings, self.seen.tensors, place)
            rows.append(readings)
            sums.append([checksum(held[name]) for name in ports])
            self.seen = dataclasses.replace(
                self.seen, measured=np.stack(rows), checksums=np.array(sums, np.int64)
            )

        self._pass(Extremes(), 0, take)

    def counts(self) -> None:
        """Count the magnitudes of every tensor over all frames."""
        blank = np.zeros((len(self.seen.tensors), BINS), np.int64)
        total = blank if self.seen.counts is None else self.seen.counts
        self.seen = dataclasses.replace(self.seen, counts=total)

        def take(readings: Readings, _held: Mapping[str, Array], _place: int) -> None:
            np.add(total, readings.astype(np.int64), out=total)

        self._pass(Counts(self.seen.exponents), len(self.frames), take)

    def _pass(
        self,
        probe: Probe,
        before: int,
        take: Callable[[Readings, Mapping[str, Array], int], None],
    ) -> None:
        """Run the rest of a pass; ``before`` frames belong to earlier passes."""
        # Skip what an interrupted run has done.
        begin = max(self.begun.done - before, 0)
        if begin >= len(self.frames):
            return
        session = probed_session(
            self.model,
            self.seen.tensors,
            probe,
            threads=self.settings.threads,
            optimize=self.settings.optimize,
            provider=self.settings.provider,
        )
        state = self.begun.state if begin else None
        readings = stream(session, self.frames, probe.width, begin, state)
        # Store the progress from time to time.
        for at, (numbers, held, after) in enumerate(readings, begin):
            take(numbers, held, self.seen.frames[at])
            done = before + at + 1
            if self.checkpoint.due(done, self.total):
                self.checkpoint.write(CalibrationState(done, self._results(), after))
            if self.progress:
                self.progress(done, self.total)

    def _results(self) -> dict[str, Array]:
        results: dict[str, Array] = {
            "measured": self.seen.measured,
            "checksums": self.seen.checksums,
        }
        if self.seen.counts is not None:
            results["counts"] = self.seen.counts
        return results


def _ports(values: Iterable[ir.Value]) -> tuple[str, ...]:
    """Return the names of inputs or outputs that hold numbers."""
    numbers = [
        each
        for each in values
        if not each.is_initializer()
        and isinstance(each.type, ir.TensorType)
        and each.type.dtype.numpy() in DTYPES.values()
    ]
    return tuple(str(each.name) for each in numbers)


def check_finite(readings: Readings, tensors: Sequence[str], place: int) -> None:
    """Raise a FramesError for a NaN or infinite element; mean squares may overflow."""
    bad = np.isnan(readings).any(1) | np.isinf(readings[:, :2]).any(1)
    bad &= ~no_element(readings)
    if not bad.any():
        return
    # Name the first tensor, and how many more there are.
    names = [tensors[at] for at in np.flatnonzero(bad).tolist()]
    kind = "NaN" if np.isnan(readings[bad][0]).any() else "infinite"
    more = f" ({', '.join(names[1:5])}{', ...' if len(names) > 5 else ''})"
    raise FramesError(
        f"frame {place} makes tensor {names[0]} {kind}, and {len(names) - 1} more of"
        f" {len(tensors)}{more if len(names) > 1 else ''}: no range can be read from it"
    )
