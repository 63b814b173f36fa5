"""An engine's answers beside its graph, both fed alike, frame by frame."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from me2e_compress.errors import EvaluationError
from me2e_compress.fidelity.dump_readings import (
    Reading,
    closeness,
    undone,
)
from me2e_compress.fidelity.fed import Fed, FeedFault, Indexed, State
from me2e_compress.fidelity.frame_order import FrameOrder
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.frames import Array, Frame

Answers: TypeAlias = Mapping[str, Array]
Closeness: TypeAlias = Mapping[tuple[str, int], float]
"""dB by output and frame."""
RECENT = 8
"""Frames in memory: 140 MB of VAD-tiny's."""
Watch: TypeAlias = Callable[[int, Answers, Answers], None]
"""Shown a frame's index, the graph's answers, and the engine's as they should be."""


@dataclasses.dataclass(frozen=True)
class Followed:
    """All frames, run as a host with some faults would have: closeness, and state."""

    close: Closeness
    own: dict[int, State]


class _Recent:
    """Frames, the last few of them in memory."""

    def __init__(self, frames: Indexed[Frame]) -> None:
        self._count = len(frames)
        self._at = functools.lru_cache(maxsize=RECENT)(frames.__getitem__)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int, /) -> Frame:
        return self._at(index)


class EngineRun:
    """What an engine answered, and what its graph answers if it is fed as the engine.

    Attributes:
        dump: What the engine answered, by frame.
        names: The outputs that both have.
        fed: What the graph is fed: state comes from the dump where it has it.
        readings: What is wrong with outputs of the dump, as found so far.
        order: The order of the dump's frames, if it is another.
        causes: What was fed wrongly, as found so far.
        inferences: Of the graph, so far.
    """

    def __init__(
        self,
        session: AnySession,
        frames: Indexed[Frame],
        dump: Indexed[Answers],
        on_inference: Callable[[int], None] = lambda count: None,
    ) -> None:
        self.dump = dump
        self.names = [name for name in session.outputs if name in dump[0]]
        self.fed = Fed(session, _Recent(frames), self._given)
        self.readings = dict[str, tuple[Reading, ...]]()
        self.order: FrameOrder | None = None
        self.causes = tuple[FeedFault, ...]()
        self.inferences = 0
        self.likes = dict[str, Array]()
        self._told = on_inference

    def __len__(self) -> int:
        return len(self.fed.frames)

    def raw(self, index: int) -> Answers:
        """Return the engine's answers to a frame as they stand in the dump."""
        return self.dump[index if self.order is None else self.order.places[index]]

    def engine(self, index: int) -> dict[str, Array]:
        """Return the engine's answers to a frame, faults of outputs undone."""
        held = self.raw(index)
        return {name: self._read(name, held[name]) for name in self.names}

    def answer(self, index: int, faults: Sequence[FeedFault]) -> dict[str, Array]:
        """Return the graph's answers on a frame, with more faults of the host."""
        self.count()
        return self.fed.answer(index, (*self.causes, *faults), self.names)

    def follow(
        self, faults: Sequence[FeedFault] = (), watch: Watch | None = None
    ) -> Followed:
        """Run all frames as the engine was fed, with more faults of the host."""
        close = dict[tuple[str, int], float]()
        fed = dataclasses.replace(self.fed, own={})
        truths = fed.follow((*self.causes, *faults), self.names)
        for index, truth in enumerate(truths):
            self.count()
            answered = self.engine(index)
            if watch is not None:
                watch(index, truth, answered)
            close |= {
                (name, index): closeness(truth[name], answered[name])
                for name in self.names
            }
        return Followed(close, fed.own)

    def count(self) -> None:
        """Count an inference, and tell it."""
        self.inferences += 1
        self._told(self.inferences)

    def check(self, names: Sequence[str]) -> None:
        """Refuse answers whose size or numbers no reading explains.

        Raises:
            EvaluationError: an output has another shape, or is not finite.
        """
        for index in range(len(self)):
            answered = self.engine(index)
            for name in names:
                value, right = answered[name], self.likes[name]
                if value.shape != right.shape:
                    raise EvaluationError(
                        f"output {name} is {list(value.shape)} in the dump at frame"
                        f" {index}, {list(right.shape)} in the graph"
                    )
                if value.dtype.kind == "f" and not np.isfinite(value).all():
                    kind = "NaN" if np.isnan(value).any() else "infinite"
                    at = np.argwhere(~np.isfinite(value))[0].tolist()
                    raise EvaluationError(
                        f"output {name} of the dump is {kind} at frame {index}, {at}"
                    )

    def _read(self, name: str, value: Array) -> Array:
        readings = self.readings.get(name)
        if not readings:
            return value
        read = undone(readings, value, self.likes[name])
        return value if read is None else read

    def _given(self, index: int) -> State:
        """Return the engine's state after a frame, where the dump has it."""
        held = self.raw(index)
        pairs = self.fed.session.recurrent.items()
        return {
            name: self._read(output, held[output])
            for name, output in pairs
            if output in held
        }
