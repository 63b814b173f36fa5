"""What a graph is fed over recorded frames, by hosts without faults and with some."""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias, TypeVar

import numpy as np

from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import DTYPES

Feeds: TypeAlias = dict[str, Array]
State: TypeAlias = Mapping[str, Array]
T_co = TypeVar("T_co", covariant=True)
OWN_STATE_BYTES = 1 << 29
"""State of our own run that is kept for single frames: 50 frames of VAD-tiny."""


class Indexed(Protocol[T_co]):
    """A recording that is read by index."""

    def __len__(self) -> int:
        """Count the frames."""
        ...

    def __getitem__(self, index: int, /) -> T_co:
        """Read one frame."""
        ...


@dataclass(eq=False)
class Fed:
    """What a graph is fed over frames: state as an engine gave it, else our own.

    Attributes:
        session: The graph.
        frames: The recording.
        given: The engine's recurrent outputs after a frame, by the graph's input;
            empty if the dump has none.
        own: Recurrent outputs of our own run after a frame, where the engine's are
            not known.
    """

    session: AnySession
    frames: Indexed[Frame]
    given: Callable[[int], State]
    own: dict[int, State] = field(default_factory=dict)

    def after(self, index: int) -> State:
        """Return the state after a frame, of the types that the graph takes."""
        held = {**self.own.get(index, {}), **self.given(index)}
        ports = self.session.inputs
        return {
            name: np.asarray(held[name], DTYPES[ports[name].type])
            for name in self.session.recurrent
        }

    def state(self, index: int) -> State:
        """Return the state that is right at a frame."""
        frame = self.frames[index]
        if frame.starts_scene or index == 0:
            return self.session.first_state(frame.arrays)
        return self.after(index - 1)

    def feeds(self, index: int, faults: Sequence["FeedFault"] = ()) -> Feeds:
        """Return what the graph is fed on a frame, by hosts with these faults."""
        found = {**self.frames[index].arrays, **self.state(index)}
        for each in sorted(faults, key=lambda fault: fault.turn):
            found = each.apply(self, index, found)
        return found

    def answer(
        self, index: int, faults: Sequence["FeedFault"], names: Sequence[str]
    ) -> dict[str, Array]:
        """Run one inference as a host with these faults would have."""
        first = self.frames[index].starts_scene
        return self.session.run(self.feeds(index, faults), names, first=first)

    def knows(self, index: int) -> bool:
        """Return whether the state before a frame is known, and the one before that."""
        earlier = (at for at in (index - 2, index - 1) if at >= 0)
        return not self._lacking or all(at in self.own for at in earlier)

    def follow(
        self, faults: Sequence["FeedFault"], names: Sequence[str]
    ) -> Iterator[dict[str, Array]]:
        """Run all frames in order, as a host with these faults would have.

        Our own state, where it counts, is that of this run; that of the first frames is
        kept.
        """
        self.own.clear()
        lacking = self._lacking
        asked = list(dict.fromkeys([*names, *lacking.values()]))
        kept = 0
        for index in range(len(self.frames)):
            found = self.answer(index, faults, asked)
            self.own[index] = {
                name: np.array(found[output]) for name, output in lacking.items()
            }
            kept += sum(each.nbytes for each in self.own[index].values())
            # two frames back is as far as any fault looks
            if kept > OWN_STATE_BYTES and index - 3 in self.own:
                dropped = self.own.pop(index - 3)
                kept -= sum(each.nbytes for each in dropped.values())
            yield {name: found[name] for name in names}

    @functools.cached_property
    def _lacking(self) -> dict[str, str]:
        """The recurrent inputs, and their outputs, that the dump does not have."""
        held = self.given(0)
        pairs = self.session.recurrent.items()
        return {name: output for name, output in pairs if name not in held}


@dataclass(frozen=True)
class FeedFault:
    """One thing that a host feeds wrongly.

    Attributes:
        kind: The fault in a word or two, for programs.
        said: What the host did, as a sentence without its end.
        turn: When it acts: frames are chosen first, then inputs are changed, then state
            is fed.
    """

    kind: str
    said: str

    turn = 1

    def apply(self, fed: Fed, index: int, feeds: Feeds) -> Feeds:
        """Return what the graph is fed instead."""
        raise NotImplementedError

    def touches(self, fed: Fed, index: int) -> bool:
        """Return whether a frame is fed otherwise than it should be."""
        return True
