"""What is said of outputs that no longer answer their inputs, and what may be why."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Literal, TypeAlias

import numpy as np

from me2e_compress.display import Table, number, table
from me2e_compress.fidelity.saturation import MOST_CUT, Cause
from me2e_compress.runtime.frames import Array

SUSPECT = 0.1
"""Below this share the int8 values before an output are looked at."""

ROUNDING = 1e-4
"""Movement, over the length of the output, that may be rounding alone: two runtimes are
3e-5 to 6e-5 apart in float32 on UniAD-tiny (docs/uniad.md)."""

END = 0.99
"""Elements of so much of the largest magnitude are at the end: -127 and -128 are."""

Verdict: TypeAlias = Literal[
    "alive", "constant", "frozen", "saturated", "deaf", "not judged"
]


@dataclasses.dataclass(frozen=True)
class OutputLiveness:
    """How one output answers.

    Attributes:
        moves: movement from frame to frame, as a share of the first graph's; None where
            that rests itself.
        answers: likewise where an input or camera is exchanged, by its name.
        cut: those that it does not answer since modules were removed.
        at_end: share of elements at the largest magnitude.
        reason: why it is not judged, or what the verdict rests on.
    """

    output: str
    verdict: Verdict
    moves: float | None
    answers: Mapping[str, float | None]
    cut: tuple[str, ...]
    at_end: float
    reason: str

    @property
    def is_dead(self) -> bool:
        """Whether it does not answer as it should."""
        return self.verdict not in ("alive", "not judged")

    def __str__(self) -> str:
        return f"{self.output} is {self.verdict}: {self.reason}"


@dataclasses.dataclass(frozen=True)
class Liveness:
    """Which outputs of a graph still answer its inputs.

    Attributes:
        alive: share of the first graph's movement below which an output is dead.
        frame: index of the frame whose inputs were exchanged.
        unjudged: inputs that tell nothing, and why.
        not_fed: recurrent inputs that the second graph has and is not fed back.
        reason: why nothing was measured; empty otherwise.
    """

    outputs: tuple[OutputLiveness, ...]
    alive: float
    frame: int = 0
    unjudged: Mapping[str, str] = dataclasses.field(default_factory=dict)
    not_fed: tuple[str, ...] = ()
    reason: str = ""

    @property
    def faults(self) -> tuple[str, ...]:
        """A sentence for each dead output, and for each state that is not fed."""
        dead = [str(each) for each in self.outputs if each.is_dead]
        return (*dead, *(f"{name} is not fed back any more" for name in self.not_fed))

    def lines(self) -> Iterator[str]:
        """Yield what answers, what an ablation cut, and what is not judged."""
        if self.reason:
            yield f"liveness: not measured ({self.reason})"
            return
        least = [
            (share, each.output, name)
            for each in self.outputs
            for name, share in (("the next frame", each.moves), *each.answers.items())
            if share is not None and name not in each.cut and each.verdict == "alive"
        ]
        if least and not self.faults:
            share, output, name = min(least)
            yield (
                f"every output is alive (least of all {output}, which answers {name}"
                f" with {share:.0%} of its movement)"
            )
        for each in self.outputs:
            if each.cut:
                cut = ", ".join(each.cut)
                yield f"since an ablation {each.output} does not answer {cut}"
        unjudged = {
            each.output: each.reason
            for each in self.outputs
            if each.verdict == "not judged"
        }
        said = (
            f"{name} ({why})" for name, why in {**unjudged, **self.unjudged}.items()
        )
        if listed := ", ".join(said):
            yield f"liveness not judged: {listed}"

    def table(self) -> Table:
        """Return a row for each output."""
        rows = []
        for each in self.outputs:
            known = [(v, k) for k, v in each.answers.items() if v is not None]
            least, name = min(known, default=(None, "-"))
            shares = number(each.moves, ".2f"), number(least, ".2f")
            rows.append((each.output, each.verdict, *shares, name))
        columns = ("output", "it is", "moves", "least answer", "to")
        note = f"Shares of the first graph's movement: dead below {self.alive:g}."
        return table("Liveness", columns, rows, note, words=2)


class Movement:
    """How far one output of both graphs moves, over frames."""

    def __init__(self) -> None:
        self.moved, self.at_end = [0.0, 0.0], [0, 0]
        self.length, self.elements, self.discrete = 0.0, 0, False

    def add(self, now: Sequence[Array], before: Sequence[Array] | None) -> None:
        """Take what both graphs answer to a frame, and to the one before."""
        self.discrete = now[0].dtype.kind not in "fc"
        self.length = math.hypot(self.length, length(now[0]))
        self.elements += now[0].size
        for side, values in enumerate(now):
            size = np.abs(np.asarray(values, np.float64))
            most = float(size.max(initial=0.0))
            self.at_end[side] += int((size >= END * most).sum()) if most else 0
            moved = 0.0 if before is None else gap(before[side], values)
            self.moved[side] = math.hypot(self.moved[side], moved)

    def judged(
        self,
        name: str,
        answers: Mapping[str, float | None],
        alive: float,
        cause: Callable[[], Cause],
        *,
        ablated: bool,
    ) -> OutputLiveness:
        """Give the verdict; `cause` looks for what makes an output rest."""
        moves = share_of(self.moved, self.length)
        known = {"the next frame": moves, **answers}
        shares = {k: v for k, v in known.items() if v is not None}
        deaf = [k for k, v in shares.items() if v < alive and k in answers]
        cut = tuple(deaf) if ablated else ()
        verdict: Verdict
        if self.discrete:
            verdict, reason = "not judged", "whole numbers"
        elif not shares:
            verdict, reason = "not judged", "it rests in the first graph too"
        else:
            found = cause() if min(shares.values()) < SUSPECT else Cause()
            low = {each: shares[each] for each in deaf if each not in cut}
            verdict, reason = self._verdict(moves, low, alive, found)
        ends = self.at_end[1] / max(self.elements, 1)
        return OutputLiveness(name, verdict, moves, answers, cut, ends, reason)

    def _verdict(
        self,
        moves: float | None,
        low: Mapping[str, float],
        alive: float,
        cause: Cause,
    ) -> tuple[Verdict, str]:
        before, ends = (count / max(self.elements, 1) for count in self.at_end)
        deaf = [f"{name} ({share:.2%})" for name, share in low.items()]
        said = "" if moves is None else f"it moves {moves:.2%} as far as before"
        why = "; ".join(filter(None, [said, cause.words]))
        if cause.saturated:
            return "saturated", why
        if moves is not None and moves < alive:
            return "frozen" if moves else "constant", why
        if ends >= MOST_CUT and before < ends / 2:
            share = f"{ends:.0%} of it are at its largest value, {before:.0%} before"
            return "saturated", share
        if deaf:
            said = f"of the movement before it answers {', '.join(deaf)}"
            return "deaf", "; ".join(filter(None, [said, cause.words]))
        return "alive", ""


def gap(x: Array, y: Array) -> float:
    """Return the distance of two arrays; infinite where their shapes differ."""
    if x.shape != y.shape:
        return math.inf
    return length(np.asarray(x, np.float64) - np.asarray(y, np.float64))


def length(values: Array) -> float:
    """Return the Euclidean length of an array."""
    return float(np.linalg.norm(np.asarray(values, np.float64).reshape(-1)))


def share_of(moved: Sequence[float], size: float) -> float | None:
    """Return the second movement as a share of the first; None if that is rounding."""
    if not ROUNDING * size < moved[0] < math.inf:
        return None
    return moved[1] / moved[0]


def share_without_jumps(x: Sequence[Array], y: Sequence[Array]) -> float:
    """Return the second movement as a share of the first, of what moves least.

    Where two slots of a set are swapped in one graph alone, a few elements jump, and
    their length hides how all others answer. So this is over that half of the elements
    that move least in the first graph, by more than rounding: of an output that is deaf
    nothing moves.

    Args:
        x: both answers of the first graph.
        y: those of the second.
    """
    if len({each.shape for each in (*x, *y)}) > 1:
        return 0.0
    first, second = (
        np.abs(np.subtract(*pair, dtype=np.float64)).reshape(-1) for pair in (x, y)
    )
    moves = first > ROUNDING * length(x[0]) / math.sqrt(max(first.size, 1))
    if not moves.any():
        return 0.0
    steady = moves & (first <= np.median(first[moves]))
    return length(second[steady]) / length(first[steady])
