"""Compare two models on the same frames: signal to noise, metres of the plan."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self, TypeAlias

import numpy as np
import numpy.typing as npt
import pydantic

from me2e_compress.base import documents
from me2e_compress.base.errors import EvaluationError, GraphError
from me2e_compress.graph.recurrence import SETS
from me2e_compress.runtime.frames import Array, Frame, Frames
from me2e_compress.runtime.plan_adapter import PLAN, PlanAdapter
from me2e_compress.runtime.session import Session, detached, replay

Float64: TypeAlias = npt.NDArray[np.float64]
Watch: TypeAlias = Callable[[dict[str, Array], dict[str, Array], Frame], None]


@dataclasses.dataclass(frozen=True)
class OutputFidelity:
    """One output, all frames pooled.

    Attributes:
        sqnr_db: 10 log10(sum a^2 / sum (a - b)^2); infinite where they are equal.
        error: largest difference over largest magnitude; infinite where a is zero and
            b is not.
        discrete: whole numbers or booleans; their SQNR says little.
        least_db: that of the noisiest frame, its noise against the mean signal of all:
            a frame to come is as likely to be noisier as any of those measured, one in
            n + 1, however they spread; sums over few frames are mostly those of one.
        most_db: that of the quietest frame.
        stray: share of the values that are a number in one model alone; above 0 the
            SQNR is -infinity. What is NaN in both, or the same infinity, is left out.
        small: channels far smaller than the largest, as ``[:, 4:84]``; else empty.
        small_db: SQNR of those.
    """

    name: str
    sqnr_db: float
    error: float
    discrete: bool = False
    least_db: float = math.inf
    most_db: float = math.inf
    stray: float = 0.0
    small: str = ""
    small_db: float | None = None

    @property
    def by_frame(self) -> str:
        """The least and most SQNR of a frame as text, dB; empty where equal."""
        least, most = self.least_db, self.most_db
        return "" if least == most else f"{least:z.1f} to {most:z.1f}"


@dataclasses.dataclass(frozen=True)
class Displacement:
    """Euclidean displacement of the waypoints, metres, over all frames."""

    mean_m: float
    max_m: float


@dataclasses.dataclass(frozen=True)
class Fidelity:
    """The result of comparing two models over a recording.

    Attributes:
        outputs: those that both models have; in the first model's order.
        missing: outputs that the second model lacks.
        plan: displacement of the plan; None if it was not measured, for `plan_reason`.
        frames: how many were compared.
        plan_output: the output that holds the plan; empty if it was not measured.
        same_choice: share of frames with the same candidate; None if no scores choose
            the plan.
        seen: more frames, which ranges were measured on: they count for `least_db` and
            `most_db` alone.
    """

    outputs: tuple[OutputFidelity, ...]
    missing: tuple[str, ...]
    plan: Displacement | None
    plan_reason: str
    frames: int
    plan_output: str = ""
    same_choice: float | None = None
    seen: int = 0

    def widen(self, seen: "Fidelity") -> "Fidelity":
        """Let `least_db` and `most_db` include ``seen`` frames, calibrated on."""
        outputs = list[OutputFidelity]()
        for a, b in zip(self.outputs, seen.outputs, strict=True):
            least, most = min(a.least_db, b.least_db), max(a.most_db, b.most_db)
            outputs.append(dataclasses.replace(a, least_db=least, most_db=most))
        return dataclasses.replace(self, outputs=tuple(outputs), seen=seen.frames)

    @property
    def stray_texts(self) -> tuple[str, ...]:
        """A sentence for each output that is a number in one model alone."""
        return tuple(
            f"{output.name}: {output.stray:.2g} of it is a number in one graph alone"
            for output in self.outputs
            if output.stray
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """A reference model with its answers, to compare many other models with.

    ``answers`` holds its outputs on every frame, all in memory.
    """

    session: Session
    frames: Frames
    answers: tuple[dict[str, Array], ...]

    @classmethod
    def of(cls, session: Session, frames: Frames) -> Self:
        """Run a model once over the frames; raises as :func:`compare` does."""
        answers = tuple(map(detached, replay(session, frames)))
        return cls(session, frames, answers)

    def compare(self, other: Session, watchers: Sequence[Watch] = ()) -> Fidelity:
        """Compare another model with it, as :func:`compare` does."""
        return compare(self.session, other, self.frames, watchers, iter(self.answers))


def compare(
    a: Session,
    b: Session,
    frames: Iterable[Frame],
    watchers: Sequence[Watch] = (),
    answers: Iterator[dict[str, Array]] | None = None,
) -> Fidelity:
    """Run two models over the same frames, each with its own recurrent state.

    Outputs that are sequences or optional are left out.

    All arithmetic is float64. One frame is in memory at a time. ``a`` is the reference,
    ``answers`` its outputs if it has run already; ``watchers`` are called with the
    outputs of both on every frame, states included, and the frame.

    Raises:
        EvaluationError: no common output, no frame, or an output of two shapes.
        FramesError: a frame does not fit one of the models.
        GraphError: a model cannot run, or nothing picks one of its plan's modes.
    """
    shared = [name for name in a.outputs if name in b.outputs]
    shared = [name for name in shared if a.outputs[name].type.startswith("tensor(")]
    if not shared:
        raise EvaluationError(
            f"no tensor in common: {', '.join(a.outputs)} and {', '.join(b.outputs)}"
        )
    # What can be compared: single outputs, and the plan
    tallies = {name: Tally(name) for name in shared}
    adapter, reason = common_adapter(a, b)
    displacements, same_modes = list[Float64](), list[bool]()
    count = 0
    # Frame by frame, with one frame in memory
    for_a, for_b, for_plans = itertools.tee(frames, 3)
    if answers is None:
        answers = replay(a, for_a)
    del for_a  # tee would store every frame that it has not read
    wanted = list(dict.fromkeys([*shared, *b.recurrent.values()]))
    runs = zip(answers, replay(b, for_b, wanted), for_plans, strict=True)
    for left, right, frame in runs:
        for name, tally in tallies.items():
            tally.add(left[name], right[name], count)
        if adapter is not None:
            plans = [adapter.plan(side, frame.arrays) for side in (left, right)]
            gap = np.where(np.isnan(plans).all(axis=0), 0.0, plans[0] - plans[1])
            lengths = np.linalg.norm(gap, axis=1)  # (waypoints,)
            displacements.append(np.nan_to_num(lengths, nan=math.inf))
            if adapter.scores is not None:
                same_modes.append(adapter.choice(left) == adapter.choice(right))
        for watch in watchers:
            watch(left, right, frame)
        count += 1
    if not count:
        raise EvaluationError("no frames to compare on")
    plan = None
    if displacements:
        plan = Displacement(float(np.mean(displacements)), float(np.max(displacements)))
    return Fidelity(
        tuple(tally.result() for tally in tallies.values()),
        tuple(name for name in a.outputs if name not in b.outputs),
        plan,
        reason,
        count,
        adapter.output if adapter is not None and displacements else "",
        float(np.mean(same_modes)) if same_modes else None,
    )


def common_adapter(a: Session, b: Session) -> tuple[PlanAdapter | None, str]:
    """Return how to read both plans, or None and why not; may raise GraphErrors."""
    adapter = PlanAdapter.of(a.metadata, list(a.outputs))
    if adapter is None:
        return None, "the model does not say which output is its plan"
    # An output called plan may lack a plan's shape
    shape = a.outputs[adapter.output].shape
    if PLAN not in a.metadata and (len(shape) not in (3, 4) or shape[-1] != 2):
        return None, f"{adapter.output} is {list(shape)}, a plan is [1, n, 2]"
    for needed in (adapter.output, adapter.scores):
        if needed is not None and needed not in b.outputs:
            return None, f"the second model has no output {needed}"
    # Several modes need something that picks one
    sides = shape if adapter.shape is None else (1, *adapter.shape)
    if len(sides) == MODES_RANK and isinstance(modes := sides[1], int):
        adapter.check_modes(modes)
    return adapter, ""


MODES_RANK = 4  # rank of a plan with modes: [1, modes, n, 2]
# Channels so many times smaller than the largest, and than the next larger ones, have
# an SQNR of their own: of the 127 steps of a scale that all share, four are theirs
SMALL_RATIO, GAP_RATIO = 30.0, 4.0
_MOST_CHANNELS = 128  # the longest axis that may be one of channels
_MOST_ASPECT = 4  # largest ratio of the sides of a picture


class Tally:
    """Sums over frames of one output: float64."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.signal = self.noise = self.gap = self.reach = 0.0
        self.noises = list[float]()  # by frame
        self.discrete, self.count, self.strays = False, 0, 0
        # By axis: signal, noise and largest value of each channel, (3, channels)
        self._channels = dict[int, Float64]()

    def add(self, a: Array, b: Array, frame: int) -> None:
        """Add a frame's arrays; an EvaluationError if their shapes differ."""
        if a.shape != b.shape:
            raise EvaluationError(
                f"output {self.name} is {list(a.shape)} in the first model,"
                f" {list(b.shape)} in the second at frame {frame}"
            )
        x, y = np.asarray(a, np.float64), np.asarray(b, np.float64)
        self.discrete = a.dtype.kind not in "fc"
        if not x.size:
            return
        # NaN or the same infinity in both is no difference, in one infinite noise
        numbers = np.isfinite(x) & np.isfinite(y)
        same = numbers | (np.isnan(x) & np.isnan(y)) | (x == y)
        strays = int(np.count_nonzero(~same))
        if not numbers.all():
            x, y = np.where(numbers, x, 0.0), np.where(numbers, y, 0.0)
        self.count, self.strays = self.count + x.size, self.strays + strays
        # Sums for the SQNR, largest values for the error
        gap = np.abs(x - y)
        signal = float(np.vdot(x, x))
        noise = math.inf if strays else float(np.vdot(gap, gap))
        self.noises.append(noise)
        self.signal += signal
        self.noise += noise
        self.reach = max(self.reach, float(np.abs(x).max()))
        self.gap = math.inf if strays else max(self.gap, float(gap.max()))
        # The same by channel
        for axis in () if self.discrete else channel_axes(x.shape):
            others = tuple(other for other in range(x.ndim) if other != axis)
            sums = self._channels.get(axis)
            if sums is None or x.shape[axis] != sums.shape[1]:
                sums = self._channels[axis] = np.zeros((3, x.shape[axis]))
            sums[0] += np.square(x).sum(axis=others)
            sums[1] += np.square(gap).sum(axis=others)
            sums[2] = np.maximum(sums[2], np.abs(x).max(axis=others))

    @property
    def sqnr_db(self) -> float:
        """The SQNR over the frames so far, dB."""
        return decibels(self.signal, self.noise)

    def result(self) -> OutputFidelity:
        """Return the output's fidelity over the frames so far."""
        error = self.gap / self.reach if self.reach else math.inf if self.gap else 0.0
        # The noisiest and the quietest frame, against the mean signal
        noises = self.noises or [0.0]
        ends = max(noises), min(noises)
        least, most = (decibels(self.signal / len(noises), noise) for noise in ends)
        stray = self.strays / self.count if self.count else 0.0
        figures = self.sqnr_db, error, self.discrete, least, most, stray
        return OutputFidelity(self.name, *figures, *self._small_channels())

    def _small_channels(self) -> tuple[str, float | None]:
        """Return the small channels of the worst axis and their SQNR; "" and None."""
        candidates = list[tuple[float, str]]()
        for axis, (signal, noise, largest) in self._channels.items():
            # Channels by size, and the first gap behind which they are small
            order = np.argsort(-largest)
            sizes = largest[order]
            lower = GAP_RATIO * sizes[1:] < sizes[:-1]
            (gaps,) = np.nonzero(lower & (SMALL_RATIO * sizes[1:] < sizes[0]))
            if gaps.size and sizes[gaps[0] + 1]:
                small = np.sort(order[gaps[0] + 1 :])
                name = f"[{':, ' * axis}{_index_ranges(small.tolist())}]"
                sqnr_db = decibels(signal[small].sum(), noise[small].sum())
                candidates.append((sqnr_db, name))
        value, name = min(candidates, default=(None, ""))
        return name, value


def channel_axes(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the axes of an output that may be its channels: none, one or two."""
    rank, axes = len(shape), tuple[int, ...]()
    if rank == 3:  # [batch, n, channels], which some heads transpose: the shorter
        axes = (1 if shape[1] < shape[2] else 2,)
    elif rank == 2 or (rank > 3 and 1 in shape[1:-1]):  # [layers, 1, n, channels]
        axes = (rank - 1,)
    elif rank == 4 and max(shape[2:]) <= _MOST_ASPECT * min(shape[2:]):  # pictures
        axes = (1,)
    elif rank > 3:  # [batch, layers, n, channels], or channels in front
        axes = 1, rank - 1
    # One channel, or very many, are none
    return tuple(axis for axis in axes if 1 < shape[axis] <= _MOST_CHANNELS)


def _index_ranges(indices: list[int]) -> str:
    """Write sorted indices as ``0, 4:84``, ends exclusive."""
    starts = [index for index in indices if index - 1 not in indices]
    ends = [index + 1 for index in indices if index + 1 not in indices]
    pairs = zip(starts, ends, strict=True)
    return ", ".join(f"{a}:{b}" if b > a + 1 else f"{a}" for a, b in pairs)


def decibels(signal: float, noise: float) -> float:
    """Return the ratio of two powers in dB; infinite without noise."""
    if noise == 0:
        return math.inf
    if math.isinf(noise):
        return -math.inf
    return 10 * math.log10(signal / noise) if signal else -math.inf


# Sets of agents: a detector that sorts them by strength swaps two of nearly the same
# strength after rounding, so each is compared with the other model's nearest one.


PRESENCE_SCORE = 0.5  # least score of an agent that counts: it is there rather than not
# Centres farther apart are two agents: the largest distance at which nuScenes'
# detection benchmark matches them
MATCH_M = 2.0


class SetOutputs(pydantic.BaseModel):
    """Outputs [1, agents, ...] whose rows belong together, in no order.

    Rows of ``boxes`` begin with x and y, metres; ``scores`` are probabilities [1,
    agents].
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    boxes: str
    scores: str
    others: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all outputs of the set."""
        return (self.boxes, self.scores, *self.others)

    @classmethod
    def of(
        cls, metadata: Mapping[str, str], shapes: Mapping[str, Sequence[object]]
    ) -> Self | None:
        """Read it from a model's metadata; None without.

        Raises:
            GraphError: it is malformed, or an output lacks a row for every agent.
        """
        if (text := metadata.get(SETS)) is None:
            return None
        try:
            outputs = cls.model_validate(documents.from_json(text))
        except (documents.MalformedError, pydantic.ValidationError) as error:
            first = str(error).splitlines()[0]
            raise GraphError(f"metadata {SETS} names no outputs: {first}") from error
        rows = tuple(shapes.get(outputs.boxes, ()))[:2]
        for name in outputs.names:
            shape = tuple(shapes.get(name, ()))
            if len(shape) < 2 or shape[:2] != rows:
                raise GraphError(f"metadata {SETS}: {name} has no row for every agent")
        return outputs


@dataclass(frozen=True)
class SetFidelity:
    """Sure agents of the first model against those of the second, all frames pooled.

    Attributes:
        agents: that the first model is sure of.
        matched: with one of the second within 2 m.
        sqnr_db: over those matched, by output.
    """

    agents: int
    matched: int
    sqnr_db: Mapping[str, float]


@dataclass
class SetTally:
    """Sums over frames of one set of outputs."""

    outputs: SetOutputs
    agents: int = 0
    matched: int = 0
    tallies: dict[str, Tally] = field(default_factory=dict)

    @classmethod
    def of(cls, a: Session, b: Session) -> Self | None:
        """Return the tally of the sets that either names and both have, or None."""
        shapes = {name: port.shape for name, port in a.outputs.items()}
        named = SetOutputs.of({**b.metadata, **a.metadata}, shapes)
        both = named is not None and set(named.names) <= set(b.outputs)
        return cls(named) if named is not None and both else None

    def add(
        self, left: Mapping[str, Array], right: Mapping[str, Array], frame: Frame
    ) -> None:
        """Match a frame's agents by the smallest sum of distances, and add them."""
        from scipy.optimize import linear_sum_assignment  # takes long to import

        outputs = self.outputs
        # Pairs of the smallest sum of distances, those farther apart than MATCH_M none
        places, others = (side[outputs.boxes][0, :, :2] for side in (left, right))
        rows = np.flatnonzero(left[outputs.scores][0] >= PRESENCE_SCORE)
        gaps = places[rows, None].astype(np.float64) - others.astype(np.float64)
        distances = np.linalg.norm(gaps, axis=2)
        picked, columns = linear_sum_assignment(np.minimum(distances, MATCH_M))
        near = distances[picked, columns] < MATCH_M
        mine, theirs = rows[picked][near], columns[near]
        self.agents += len(rows)
        self.matched += len(mine)
        # Signal and noise of matched rows
        for name in outputs.names:
            tally = self.tallies.setdefault(name, Tally(name))
            tally.add(left[name][0][mine], right[name][0][theirs], frame.index)

    def result(self) -> SetFidelity:
        """Return the figures over the frames so far."""
        sqnr_db = {name: tally.sqnr_db for name, tally in self.tallies.items()}
        return SetFidelity(self.agents, self.matched, sqnr_db if self.matched else {})
