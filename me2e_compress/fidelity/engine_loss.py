"""What an engine lost, output by output: to quantization, compilation and its host."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from me2e_compress.fidelity.dump_readings import LOWEST_DB
from me2e_compress.fidelity.engine_run import EngineRun
from me2e_compress.fidelity.floor import ALIVE
from me2e_compress.fidelity.output_liveness import Movement
from me2e_compress.fidelity.saturation import Cause
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.frames import Array


@dataclasses.dataclass(frozen=True)
class OutputLoss:
    """What one output lost, in dB of SQNR over all frames; infinite where nothing.

    Attributes:
        quantization_db: The graph against its float source, both fed as they should be;
            None without a float source.
        compilation_db: The engine against the graph, once faults of the host are
            undone.
        host_db: What faults of the host changed; None if none was named, or it changed
            the output beyond comparison.
        all_db: The engine as it was dumped against the float source, or against the
            graph without one; None if it cannot be compared.
        moves: How far the engine's answers move from frame to frame, as a share of the
            source's, or the graph's without one; None if those rest.
        dead: What is wrong if it moves hardly at all; empty otherwise.
    """

    name: str
    quantization_db: float | None
    compilation_db: float
    host_db: float | None
    all_db: float | None
    moves: float | None
    dead: str


class _Sums:
    """Signal and noise of one comparison of one output."""

    def __init__(self) -> None:
        self.signal = self.noise = 0.0
        self.known = False

    def add(self, truth: Array, found: Array | None) -> None:
        if found is None or found.shape != truth.shape:
            self.noise = math.nan
            return
        wide = np.asarray(truth, np.float64)
        with np.errstate(invalid="ignore"):  # bytes that are read wrongly may be NaN
            gap = wide - np.asarray(found, np.float64)
        self.known = True
        self.signal += float(np.vdot(wide, wide))
        self.noise += float(np.vdot(gap, gap))

    @property
    def decibels(self) -> float | None:
        if not self.known or not math.isfinite(self.noise):
            return None
        if self.noise == 0:
            return math.inf
        return 10 * math.log10(self.signal / self.noise) if self.signal else -math.inf


def losses(
    run: EngineRun, source: AnySession | None, alive: float = ALIVE
) -> tuple[OutputLoss, ...]:
    """Run all graphs side by side over the frames, and split what each output lost.

    An output is dead that moves less than ``alive`` of what it should.
    """
    names = run.names
    movements, last = {name: Movement() for name in names}, dict[str, Sequence[Array]]()
    shared = [] if source is None else [n for n in names if n in source.outputs]
    parts = ("quantization", "compilation", "host", "all")
    sums = {name: {part: _Sums() for part in parts} for name in names}
    right, fed = (replace(run.fed, own={}) for _ in range(2))
    as_engine = fed.follow(run.causes, names) if run.causes else None
    floats: Iterator[dict[str, Array]] = iter(())
    if source is not None:
        floats = replace(run.fed, session=source, own={}).follow((), shared)
    for index, truth in enumerate(right.follow((), names)):
        as_fed = truth if as_engine is None else next(as_engine)
        exact = next(floats, {})
        read, dumped = run.engine(index), run.dump[index]
        for name, each in sums.items():
            if name in exact:
                each["quantization"].add(exact[name], truth[name])
            each["compilation"].add(as_fed[name], read[name])
            changed = _changed(read[name], dumped[name])
            found = None if changed is None else np.add(as_fed[name], changed)
            each["host"].add(truth[name], found)
            each["all"].add(exact.get(name, truth[name]), dumped[name])
            pair = np.array(exact.get(name, as_fed[name])), np.array(read[name])
            movements[name].add(pair, last.get(name))
            last[name] = pair
    faulty = run.causes or run.order
    moved = {
        name: each.judged(name, {}, alive, Cause, ablated=False)
        for name, each in movements.items()
    }
    return tuple(
        OutputLoss(
            name,
            each["quantization"].decibels,
            _known(each["compilation"].decibels),
            each["host"].decibels if faulty or run.readings.get(name) else None,
            each["all"].decibels,
            moved[name].moves,
            str(moved[name]) if moved[name].is_dead else "",
        )
        for name, each in sums.items()
    )


def _changed(read: Array, dumped: Array) -> Array | None:
    """Return what reading an output wrongly added to it; None if the shape differs."""
    if read.shape != dumped.shape:
        return None
    with np.errstate(all="ignore"):  # bytes of another type are any numbers
        return np.asarray(dumped, np.float64) - np.asarray(read, np.float64)


def _known(decibels: float | None) -> float:
    return LOWEST_DB if decibels is None else decibels
