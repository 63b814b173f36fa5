"""What an engine lost, output by output: to quantization and to compilation."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from me2e_compress.fidelity.engine_run import EngineRun
from me2e_compress.fidelity.floor import ALIVE
from me2e_compress.fidelity.liveness import OutputTally
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import Session

LOWEST_DB = -20.0
"""The closeness of outputs that cannot be compared, since the graph's is not finite."""


@dataclasses.dataclass(frozen=True)
class OutputLoss:
    """What one output lost, in dB of SQNR over all frames; infinite where nothing.

    Attributes:
        quantization_db: The graph against its float source; None without one.
        compilation_db: The engine, and the host that feeds it, against the graph.
        all_db: The engine against the float source, or against the graph without one;
            None if it cannot be compared.
        moves: Standard deviation of the engine's answers over the frames, as a share of
            the source's, or the graph's without one; None if those rest.
        dead: What is wrong if it moves hardly at all; empty otherwise.
    """

    name: str
    quantization_db: float | None
    compilation_db: float
    all_db: float | None
    moves: float | None
    dead: str


class _Sums:
    """Signal and noise of one comparison of one output."""

    def __init__(self) -> None:
        self.signal = self.noise = 0.0
        self.known = False

    def add(self, truth: Array, value: Array) -> None:
        if value.shape != truth.shape:
            self.noise = math.nan
            return
        wide = np.asarray(truth, np.float64)
        gap = wide - np.asarray(value, np.float64)
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
    run: EngineRun,
    source: Session | None,
    alive: float = ALIVE,
    on_frame: Callable[[int], None] = lambda index: None,
) -> tuple[OutputLoss, ...]:
    """Run both graphs side by side over the frames, and split what each output lost.

    An output is dead that moves less than ``alive`` of what it should. ``on_frame`` is
    called with the index of every frame.

    Raises:
        EvaluationError: an output of the engine has another shape than the graph's, or
            is not finite.
    """
    names = run.names
    movements = {name: OutputTally(name) for name in names}
    parts = ("quantization", "compilation", "all")
    sums = {name: {part: _Sums() for part in parts} for name in names}
    floats: Iterator[tuple[object, Mapping[str, Array]]] = iter(())
    if source is not None:
        floats = run.follow(source, [name for name in names if name in source.outputs])
    for index, (_, truth) in enumerate(run.follow(run.session, names)):
        on_frame(index)
        run.check(index, truth)
        dumped, (_, exact) = run.dump[index], next(floats, (None, {}))
        for name, parted in sums.items():
            right = exact.get(name, truth[name])
            if name in exact:
                parted["quantization"].add(right, truth[name])
            parted["compilation"].add(truth[name], dumped[name])
            parted["all"].add(right, dumped[name])
            movements[name].add(right, dumped[name])
    moved = {name: movement.result(alive) for name, movement in movements.items()}
    return tuple(
        OutputLoss(
            name,
            parted["quantization"].decibels,
            _known(parted["compilation"].decibels),
            parted["all"].decibels,
            moved[name].moves,
            str(moved[name]) if moved[name].is_dead else "",
        )
        for name, parted in sums.items()
    )


def _known(decibels: float | None) -> float:
    return LOWEST_DB if decibels is None else decibels
