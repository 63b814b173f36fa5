"""Calibrate all files of a stack in one streaming pass of the whole."""

import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Progress, check_finite
from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.calibration.part_frames import part_fingerprint
from me2e_compress.calibration.probes import Counts, Extremes, Probe
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.statistics import BINS, Statistics
from me2e_compress.calibration.stream import (
    READINGS,
    Readings,
    Recording,
    probed_session,
)
from me2e_compress.errors import FramesError
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay
from me2e_compress.runtime.stack.split_stack import SplitStack
from me2e_compress.runtime.stack.stack_session import PartRun, StackSession


@dataclasses.dataclass(frozen=True)
class StackCalibrator:
    """Measure the ranges of every file of a stack, with options of ``Calibrator``."""

    method: str = "max-min"
    threads: int = 0
    provider: Provider = CPU

    def run(
        self,
        stack: SplitStack,
        models: Mapping[str, ir.Model],
        tensors: Mapping[str, Sequence[str]],
        frames: Recording,
        progress: Progress | None = None,
    ) -> dict[str, Ranges]:
        """Run the stack over the frames, once; twice where histograms are needed.

        ``models`` has the float graph of every file by label, ``tensors`` those to
        measure in it, none for a file that stays float. ``progress`` is called with
        frames done and all frames, of all passes.
        """
        counting = OBSERVERS.parse(self.method).counts
        job = _Job(self, stack, models, tensors, frames, 2 if counting else 1, progress)
        seen = job.extremes()
        if counting:
            seen = job.counts(seen)
        method = OBSERVERS.parse(self.method)
        return {label: Ranges.of(each, method) for label, each in seen.items()}


@dataclasses.dataclass(frozen=True)
class _Job:
    """One calibration of a stack."""

    settings: StackCalibrator
    stack: SplitStack
    models: Mapping[str, ir.Model]
    tensors: Mapping[str, Sequence[str]]
    frames: Recording
    passes: int
    progress: Progress | None

    def extremes(self) -> dict[str, Statistics]:
        """Measure minimum, maximum and mean square of every tensor and frame."""
        rows = {label: list[Readings]() for label in self.models}
        places = {label: list[int]() for label in self.models}

        def take(at: int, label: str, readings: Readings) -> None:
            place = self.frames.places[at]
            check_finite(readings, self.tensors[label], place)
            rows[label].append(readings)
            places[label].append(place)

        # A file may run at only some of the frames.
        self._pass({label: Extremes() for label in self.models}, 0, take)
        for label, each in rows.items():
            if not each:
                raise FramesError(f"{label}: runs at none of {len(self.frames)} frames")
        # Each file has statistics of the frames at which it ran.
        return {
            label: Statistics(
                graph.digest(model),
                part_fingerprint(self.stack, label, self.frames),
                tuple(self.tensors[label]),
                tuple(places[label]),
                np.stack(rows[label]),
            )
            for label, model in self.models.items()
        }

    def counts(self, seen: Mapping[str, Statistics]) -> dict[str, Statistics]:
        """Count the magnitudes of every tensor over all frames."""
        totals = {
            label: np.zeros((len(each.tensors), BINS), np.int64)
            for label, each in seen.items()
        }

        def take(at: int, label: str, readings: Readings) -> None:
            totals[label] += readings.astype(np.int64)

        probes = {label: Counts(each.exponents) for label, each in seen.items()}
        self._pass(probes, len(self.frames), take)
        return {
            label: dataclasses.replace(each, counts=totals[label])
            for label, each in seen.items()
        }

    def _pass(
        self,
        probes: Mapping[str, Probe],
        before: int,
        take: Callable[[int, str, Readings], None],
    ) -> None:
        """Run the stack over all frames, with probes in every file."""
        sessions = {label: self._session(label, probes[label]) for label in self.models}
        session = _ProbedStack(self.stack, sessions, self.settings.provider)
        # Replaying the stack runs the probes of all its files.
        for at, _ in enumerate(replay(session, self.frames, ())):
            for label, readings in session.taken.items():
                take(at, label, readings.reshape(-1, probes[label].width))
            session.taken.clear()
            if self.progress is not None:
                self.progress(before + at + 1, self.passes * len(self.frames))

    def _session(self, label: str, probe: Probe) -> AnySession:
        model, threads = self.models[label], self.settings.threads
        provider = self.settings.provider
        if not self.tensors[label]:
            return Session(model, threads=threads, release=True, provider=provider)
        return probed_session(
            model,
            self.tensors[label],
            probe,
            threads=threads,
            optimize=True,
            provider=provider,
        )


class _ProbedStack(StackSession):
    """A stack with probes; ``taken`` has the latest readings by label."""

    def __init__(
        self,
        stack: SplitStack,
        sessions: Mapping[str, AnySession],
        provider: Provider,
    ) -> None:
        super().__init__(stack, sessions, provider)
        self.taken = dict[str, Readings]()

    def runs(
        self,
        feeds: Mapping[str, Array],
        *,
        first: bool = False,
        parts: Collection[str] | None = None,
    ) -> Iterator[PartRun]:
        """Run the files in order, and keep the readings of their probes."""
        for each in super().runs(feeds, first=first, parts=parts):
            empty = np.empty(0, np.float32)
            self.taken[each.label] = each.values.get(READINGS, empty).astype(np.float32)
            yield each
