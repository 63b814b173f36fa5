"""Whether the outputs of a graph still move as those of another do.

A graph may keep nearly every decibel and have one output that is dead: a plan that
rests while boxes and view are perfect. So the standard deviation of each output over
the frames is compared with that of the first graph.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Literal, TypeAlias

import numpy as np

from me2e_compress.base.display import Table, format_number, table
from me2e_compress.fidelity import ALIVE
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session

# A deviation, over the length of the output, that may be rounding alone: two runtimes
# are 3e-5 to 6e-5 apart in float32 on UniAD-tiny (models/README.md)
ROUNDING = 1e-4
WEAK = 0.5  # an output that moves less far than this share of before is alive, but weak

Verdict: TypeAlias = Literal["alive", "weak", "constant", "frozen", "not judged"]


@dataclasses.dataclass(frozen=True)
class OutputLiveness:
    """How far one output moves.

    Attributes:
        moves: its standard deviation over the frames, as a share of the first graph's;
            None where that rests itself.
        reason: why it is not judged, or what the verdict rests on.
    """

    output: str
    verdict: Verdict
    moves: float | None
    reason: str = ""

    @property
    def is_dead(self) -> bool:
        """Whether it does not move as it should."""
        return self.verdict in ("constant", "frozen")

    def __str__(self) -> str:
        return f"{self.output} is {self.verdict}: {self.reason}"


@dataclasses.dataclass(frozen=True)
class Liveness:
    """Which outputs of a graph still move.

    Attributes:
        alive: share of the first graph's deviation below which an output is dead.
        not_fed: recurrent inputs that the second graph has and is not fed back.
        reason: why nothing was measured; empty otherwise.
    """

    outputs: tuple[OutputLiveness, ...]
    alive: float
    not_fed: tuple[str, ...] = ()
    reason: str = ""

    @property
    def faults(self) -> tuple[str, ...]:
        """A sentence for each dead output, and for each state that is not fed back."""
        dead = [str(output) for output in self.outputs if output.is_dead]
        return (*dead, *(f"{name} is not fed back any more" for name in self.not_fed))

    def lines(self) -> Iterator[str]:
        """Yield which output moves least, and what is not judged."""
        if self.reason:
            yield f"liveness: not measured ({self.reason})"
            return
        moving = [
            (output.moves, output.output)
            for output in self.outputs
            if output.verdict in ("alive", "weak") and output.moves is not None
        ]
        if moving and not self.faults:
            share, output = min(moving)
            words = "every output is alive" if share >= WEAK else "none dead, but weak"
            yield f"{words} (least of all {output}: {share:.0%})"
        rests = [o for o in self.outputs if o.verdict == "not judged"]
        if rests:
            reasons = ", ".join(f"{o.output} ({o.reason})" for o in rests)
            yield f"liveness not judged: {reasons}"

    def table(self) -> Table:
        """Return a row for each output."""
        rows = [
            (o.output, o.verdict, format_number(o.moves, ".2f")) for o in self.outputs
        ]
        note = (
            "Standard deviation over the frames, as a share of the first graph's: dead"
            f" below {self.alive:g}."
        )
        return table("Liveness", ("output", "it is", "moves"), rows, note, words=2)


class OutputTally:
    """The standard deviation of one output over frames, in both graphs."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._frames, self._resized, self._discrete = 0, False, False
        self._mean = self._squares = np.zeros(2)  # (graphs, *shape of the output)

    def add(self, first: Array, second: Array) -> None:
        """Add what both graphs give in a frame; NaN and infinities count as 0."""
        if first.shape != second.shape or (
            self._frames and first.shape != self._mean.shape[1:]
        ):
            self._resized = True
            return
        pair = np.stack((first, second)).astype(np.float64)
        pair = np.nan_to_num(pair, posinf=0.0, neginf=0.0)
        if not self._frames:
            self._discrete = first.dtype.kind not in "fc"
            self._mean, self._squares = np.zeros_like(pair), np.zeros_like(pair)
        # Welford's update of mean and sum of squares
        self._frames += 1
        gap = pair - self._mean
        self._mean += gap / self._frames
        self._squares += gap * (pair - self._mean)

    def result(self, alive: float) -> OutputLiveness:
        """Return the verdict: dead below ``alive`` of the first graph's deviation."""
        if self._resized:
            return OutputLiveness(self.name, "not judged", None, "its shape changes")
        # Norms over all elements: of the standard deviations, and of the first mean
        squares = self._squares.reshape(2, -1).sum(axis=1)
        first, second = np.sqrt(squares / max(self._frames, 1)).tolist()
        length = math.hypot(float(np.linalg.norm(self._mean[0])), first)
        if first <= ROUNDING * length:
            reason = "it rests in the first graph too"
            return OutputLiveness(self.name, "not judged", None, reason)
        moves = second / first
        if self._discrete:
            return OutputLiveness(self.name, "not judged", moves, "whole numbers")
        if moves >= alive:
            verdict: Verdict = "alive" if moves >= WEAK else "weak"
            return OutputLiveness(self.name, verdict, moves)
        verdict = "frozen" if moves else "constant"
        reason = f"it moves {moves:.2%} as far as before"
        return OutputLiveness(self.name, verdict, moves, reason)


class LivenessTally:
    """Watches how the outputs of two graphs move over frames."""

    def __init__(self, a: Session, b: Session) -> None:
        self._tallies: dict[str, OutputTally] = {}
        recurrent = [name for name in a.recurrent if name in b.inputs]
        self._not_fed = tuple(name for name in recurrent if name not in b.recurrent)
        self._frames = 0

    def add(
        self, left: Mapping[str, Array], right: Mapping[str, Array], frame: Frame
    ) -> None:
        """Add the outputs of both graphs in a frame; those of one alone are ignored."""
        self._frames += 1
        for name in (output for output in right if output in left):
            tally = self._tallies.setdefault(name, OutputTally(name))
            tally.add(left[name], right[name])

    def result(self, alive: float = ALIVE) -> Liveness:
        """Return the verdicts, if there are two frames or more."""
        if self._frames < 2:
            return Liveness((), alive, reason="one frame alone: nothing moves")
        outputs = (tally.result(alive) for tally in self._tallies.values())
        return Liveness(tuple(outputs), alive, self._not_fed)
