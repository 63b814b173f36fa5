"""Measure whether the outputs of a graph still answer its inputs as another's do.

A graph may keep nearly every decibel and have one output that is dead: a plan that
rests while boxes and view are perfect. So each output is asked how far it moves from
frame to frame, and how far when one input alone is exchanged for another frame's.
"""

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Self, TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.errors import FramesError, GraphError
from me2e_compress.fidelity.compare import compare
from me2e_compress.fidelity.floor import ALIVE
from me2e_compress.fidelity.output_liveness import (
    Liveness,
    Movement,
    gap,
    length,
    share_of,
    share_without_jumps,
)
from me2e_compress.fidelity.saturation import cause_of
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session, detached

LEAST_SIDE = 16
"""Least rows and columns of a camera's picture."""

NOTHING = np.zeros(())
"""Stands for a state that is not fed."""

Sides: TypeAlias = tuple[dict[str, Array], dict[str, Array]]
"""Arrays by name, of the first graph and of the second."""


def measure_liveness(
    a: Session, b: Session, frames: Iterable[Frame], alive: float = ALIVE
) -> Liveness:
    """Run two graphs over frames and compare how their outputs answer.

    Errors are those of :func:`me2e_compress.fidelity.compare.compare`.
    """
    tally = LivenessTally(a, b)
    compare(a, b, frames, tally.add)
    return tally.result(alive)


@dataclasses.dataclass(frozen=True)
class Part:
    """What is exchanged at once: an input, or one of its cameras."""

    input: str
    camera: int | None = None

    def __str__(self) -> str:
        if self.camera is None:
            return self.input
        return f"camera {self.camera} of {self.input}"

    def of(self, array: Array) -> Array:
        """Return a view of this part of an input's array."""
        if self.camera is None:
            return array
        view: Array = np.moveaxis(array, -4, 0)[self.camera]
        return view


def parts_of(name: str, array: Array) -> list[Part]:
    """List the cameras of an input, or the input as a whole.

    The dimension before the last three counts cameras, as in [1, 6, 3, H, W] and
    [6, 3, H, W], if it is above 1, three channels stand right behind it or last, and
    rows and columns are 16 or more.
    """
    if array.ndim < 4 or array.shape[-4] < 2:
        return [Part(name)]
    *_, cameras, first, second, last = array.shape
    sides = (second, last) if first == 3 else (first, second) if last == 3 else (0,)
    if min(sides) < LEAST_SIDE:
        return [Part(name)]
    return [Part(name, camera) for camera in range(cameras)]


@dataclasses.dataclass(frozen=True)
class _Moment:
    """One frame, with what both graphs remembered and answered."""

    frame: Frame
    scene: int
    states: Sides
    answers: Sides

    def feeds(self, side: int) -> dict[str, Array]:
        return {**self.frame.arrays, **self.states[side]}


@dataclasses.dataclass(frozen=True)
class _Donor:
    """What takes the place of a part, in each graph; `near` is of the same scene."""

    near: bool
    distance: float
    values: tuple[Array, ...]

    @classmethod
    def of(cls, part: Part, base: _Moment, other: _Moment) -> Self:
        # each graph gets its own state, of the same frame
        held, *given = (
            part.of(each.feeds(side).get(part.input, NOTHING))
            for each, side in ((base, 0), (other, 0), (other, 1))
        )
        distance = gap(held, given[0])
        return cls(base.scene == other.scene, distance, tuple(given))


class LivenessTally:
    """Watches two graphs over frames, then exchanges one input after the other.

    The frame whose inputs are exchanged is the first that continues a scene, since it
    has a history; where there is none, the first. Each part is taken from the frame
    where it differs most, of the same scene if it changes there: one more inference of
    each graph for every part that ever changes. Where an output seems deaf to it, it is
    taken from a second frame too: a graph that picks may have jumped but once.
    """

    def __init__(self, a: Session, b: Session) -> None:
        self._sessions = a, b
        names = [name for name in a.outputs if name in b.outputs]
        self._movements = {name: Movement() for name in names}
        self._donors = dict[Part, list[_Donor]]()
        self._last: _Moment | None = None
        self._base: _Moment | None = None
        self._scene = self._frames = 0

    def add(
        self, left: dict[str, Array], right: dict[str, Array], frame: Frame
    ) -> None:
        """Take what both graphs answer to a frame, the state of each included."""
        last, answers = self._last, (detached(left), detached(right))
        self._scene += frame.starts_scene
        self._frames += 1
        states = self._state(0, frame), self._state(1, frame)
        moment = self._last = _Moment(frame, self._scene, states, answers)
        for name, movement in self._movements.items():
            before = None if last is None else [side[name] for side in last.answers]
            movement.add([side[name] for side in answers], before)
        # a frame with a history is a better base than one without
        base = self._base
        if base is None or (base.frame.starts_scene and not frame.starts_scene):
            base, moment = moment, last or moment
            self._base, self._donors = base, self._parts(base)
        for part, donors in self._donors.items():
            found = _Donor.of(part, base, moment)
            if found.distance > 0:
                donors.append(found)
                donors.sort(key=lambda each: (each.near, each.distance), reverse=True)
                del donors[2:]

    def result(
        self,
        alive: float = ALIVE,
        model: ir.Model | None = None,
        *,
        ablated: bool = False,
    ) -> Liveness:
        """Exchange every part and judge every output.

        Args:
            alive: share of the first graph's movement below which an output is dead.
            model: the second graph, to look for what makes an output rest.
            ablated: whether modules were removed from it: who is deaf is meant to be.
        """
        base, (first, second) = self._base, self._sessions
        if base is None or self._frames < 2:
            return Liveness((), alive, reason="one frame alone: nothing moves")
        answers, unjudged = self._exchange(base, alive)
        found = []
        for name, movement in self._movements.items():
            why = partial(cause_of, model, name, base.feeds(1), second.provider)
            found.append(
                movement.judged(name, answers[name], alive, why, ablated=ablated)
            )
        held = [name for name in first.recurrent if name in second.inputs]
        not_fed = [name for name in held if name not in second.recurrent]
        return Liveness(tuple(found), alive, base.frame.index, unjudged, tuple(not_fed))

    def _parts(self, base: _Moment) -> dict[Part, list[_Donor]]:
        """List what can be exchanged of a frame, so far with nothing."""
        fed = base.feeds(0).items()
        return {part: [] for name, array in fed for part in parts_of(name, array)}

    def _state(self, side: int, frame: Frame) -> dict[str, Array]:
        """Return what a graph remembers at a frame, as replays feed it."""
        session = self._sessions[side]
        if frame.starts_scene or self._last is None:
            return session.first_state(frame.arrays)
        held = self._last.answers[side]
        return {name: held[answer] for name, answer in session.recurrent.items()}

    def _exchange(
        self, base: _Moment, alive: float
    ) -> tuple[dict[str, dict[str, float | None]], dict[str, str]]:
        """Return how outputs answer each part, and why some parts tell nothing."""
        answers: dict[str, dict[str, float | None]] = {n: {} for n in self._movements}
        unjudged = dict[str, str]()
        for part, donors in self._donors.items():
            told = str(part)
            if not donors:
                unjudged[told] = "the same in all frames"
            for donor in donors:
                try:
                    found = self._shares(base, part, donor)
                except (GraphError, FramesError) as error:
                    unjudged[told] = str(error)
                    break
                for name, share in found.items():
                    known = (answers[name].get(told), share)
                    both = [each for each in known if each is not None]
                    answers[name][told] = max(both, default=None)
                least = [
                    share for e in answers.values() if (share := e[told]) is not None
                ]
                if min(least, default=alive) >= alive:
                    break
        return answers, unjudged

    def _shares(
        self, base: _Moment, part: Part, donor: _Donor
    ) -> dict[str, float | None]:
        """Return how every output answers a part of another frame."""
        changed = [self._exchanged(side, base, part, donor) for side in (0, 1)]
        found = dict[str, float | None]()
        for name in self._movements:
            sides = [
                (side[name], now[name])
                for side, now in zip(base.answers, changed, strict=True)
            ]
            moved = [gap(*pair) for pair in sides]
            share = found[name] = share_of(moved, length(sides[0][0]))
            if share is not None:
                found[name] = max(share, share_without_jumps(*sides))
        return found

    def _exchanged(
        self, side: int, base: _Moment, part: Part, donor: _Donor
    ) -> dict[str, Array]:
        """Run a graph on a frame with one part exchanged."""
        session, feeds = self._sessions[side], base.feeds(side)
        if part.input not in session.inputs:
            return base.answers[side]
        if part.camera is None:
            feeds[part.input] = donor.values[side]
        else:
            feeds[part.input] = feeds[part.input].copy()
            part.of(feeds[part.input])[...] = donor.values[side]
        return detached(session.run(feeds, list(self._movements)))
