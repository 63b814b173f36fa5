"""Ways in which a host feeds an engine wrongly: state, frames, inputs, pictures.

A fault changes what a graph is fed on a frame. If the graph, fed so, answers as the
engine did, then the engine was fed so.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.fidelity.fed import Fed, FeedFault, Feeds
from me2e_compress.runtime.frames import Array

Change: TypeAlias = Callable[[Any], Any]
"""Returns an input, changed."""
MOST_CAMERAS = 12
SMALLEST_PICTURE = 8
"""Rows and columns; a matrix has fewer."""


@dataclass(frozen=True)
class Pixels:
    """How pixels became an image input: (scale * pixel - mean) / std, by channel."""

    mean: tuple[float, ...]
    std: tuple[float, ...]
    scale: float = 1.0


@dataclass(frozen=True)
class StateFault(FeedFault):
    """State of some recurrent inputs: carried over, one frame late, or never fed."""

    how: Literal["carried", "late", "never"]
    names: tuple[str, ...]
    turn = 2

    def apply(self, fed: Fed, index: int, feeds: Feeds) -> Feeds:
        """Feed the state that this fault leaves."""
        if not self.touches(fed, index):
            return feeds
        if self.how == "carried":
            state = fed.after(index - 1)
        elif self.how == "late":
            state = fed.state(index - 1)
        else:
            state = fed.session.first_state({})
        return feeds | {name: state[name] for name in self.names}

    def touches(self, fed: Fed, index: int) -> bool:
        """Return whether a scene starts here, or does not.

        What a late state is behind the first frame of a later scene, a host may have
        cleared or not.
        """
        starts = fed.frames[index].starts_scene
        if self.how == "late" and index > 1 and fed.frames[index - 1].starts_scene:
            return False
        return index > 0 and starts == (self.how == "carried")


@dataclass(frozen=True)
class FrameFault(FeedFault):
    """Inputs of another frame: so many frames away, or of one frame for ever.

    ``names`` are the inputs; ``away`` None takes the first frame.
    """

    names: tuple[str, ...]
    away: int | None
    turn = 0

    def apply(self, fed: Fed, index: int, feeds: Feeds) -> Feeds:
        """Feed the inputs of the other frame."""
        held = fed.frames[self._other(fed, index)].arrays
        return feeds | {name: held[name] for name in self.names}

    def touches(self, fed: Fed, index: int) -> bool:
        """Return whether the other frame differs."""
        mine, other = (fed.frames[at].arrays for at in (index, self._other(fed, index)))
        return any(not np.array_equal(mine[name], other[name]) for name in self.names)

    def _other(self, fed: Fed, index: int) -> int:
        if self.away is None:
            return 0
        return min(max(index + self.away, 0), len(fed.frames) - 1)


@dataclass(frozen=True)
class InputFault(FeedFault):
    """One input, changed in the same way on every frame."""

    name: str
    change: Change

    def apply(self, fed: Fed, index: int, feeds: Feeds) -> Feeds:
        """Feed the changed input."""
        value = feeds[self.name]
        changed: Array = self.change(value).astype(value.dtype)
        return feeds | {self.name: changed}


def feed_faults(
    fed: Fed, pixels: Mapping[str, Pixels]
) -> Iterator[tuple[FeedFault, ...]]:
    """Propose faults in groups, the common ones first; camera orders come apart."""
    states = tuple(fed.session.recurrent)
    inputs = [name for name in fed.frames[0].arrays if name not in states]
    yield tuple(_of_state(states))
    yield tuple(_of_frames(inputs))
    for name in inputs:
        value = fed.frames[0].arrays[name]
        yield tuple(_of_input(name, value, pixels.get(name)))


def _of_state(states: Sequence[str]) -> Iterator[StateFault]:
    # all state at once, then each of several
    every = tuple(states)
    for names in dict.fromkeys(
        [every, *((name,) for name in states)] if states else []
    ):
        said = "the state" if names == every else names[0]
        yield StateFault(
            "state-not-reset", f"{said} is not reset where a scene begins",
            "carried", names,
        )  # fmt: skip
        yield StateFault(
            "state-late", f"{said} is one frame stale: it is that before the last",
            "late", names,
        )  # fmt: skip
        yield StateFault(
            "state-never-fed", f"{said} is never fed: it stays at its first value",
            "never", names,
        )  # fmt: skip


def _of_frames(inputs: Sequence[str]) -> Iterator[FrameFault]:
    for away, said in ((-1, "before"), (1, "after")):
        yield FrameFault(
            "frames-shifted", f"frames are shifted by one: each is fed the one {said}",
            tuple(inputs), away,
        )  # fmt: skip
    for name in inputs:
        yield FrameFault(
            "input-stuck", f"input {name} is stuck at its first frame", (name,), None
        )
        yield FrameFault("input-late", f"input {name} is one frame late", (name,), -1)


def _of_input(name: str, value: Array, pixels: Pixels | None) -> Iterator[InputFault]:
    def fault(kind: str, said: str, change: Change) -> InputFault:
        return InputFault(kind, f"input {name} {said}", name, change)

    yield fault("input-never-fed", "is never fed: it stays zero", np.zeros_like)
    if value.ndim >= 2 and value.shape[-1] == value.shape[-2] and value.shape[-1] <= 4:
        yield fault(
            "input-layout", "has its matrices transposed", lambda x: x.swapaxes(-1, -2)
        )
        if value.dtype.kind == "f":
            yield fault("input-inverse", "has its matrices inverted", np.linalg.pinv)
    if (channels := _colour_axis(value)) is None:
        return
    # pictures: their range, then channels and layout
    if value.dtype.kind == "f":
        for said, change in _ranges(channels, pixels):
            yield fault("normalisation", said, change)
    yield fault("colours", "has red and blue swapped", _swapped(channels, pixels))
    yield fault(
        *("input-layout", "has its channels last, read as first"),
        lambda x: np.moveaxis(x, channels, -1).reshape(x.shape),
    )


def _ranges(channels: int, pixels: Pixels | None) -> Iterator[tuple[str, Change]]:
    """Propose other ranges of pictures; those of grey levels need their statistics."""
    yield "is of 0 to 1 where 0 to 255 is meant: divided by 255", lambda x: x / 255
    yield "is of 0 to 255 where 0 to 1 is meant: times 255", lambda x: x * 255
    if pixels is None:
        return
    mean, std = (_by_channel(each, channels) for each in (pixels.mean, pixels.std))
    yield "is not normalised: neither mean nor std", lambda x: x * std + mean
    yield "is not normalised: grey levels of 0 to 1", lambda x: (x * std + mean) / 255
    yield (
        "is of 0 to 1 before mean and std of 0 to 255",
        lambda x: ((x * std + mean) / 255 - mean) / std,
    )
    yield "misses the mean", lambda x: x + mean / std
    yield "misses the std", lambda x: x * std
    yield "is normalised twice", lambda x: (x - mean) / std


def _swapped(channels: int, pixels: Pixels | None) -> Change:
    """Return what swaps red and blue before the normalisation."""
    if pixels is None:
        return lambda x: np.flip(x, channels)
    mean, std = (_by_channel(each, channels) for each in (pixels.mean, pixels.std))
    return lambda x: (np.flip(x * std + mean, channels) - mean) / std


def _by_channel(values: Sequence[float], channels: int) -> npt.NDArray[np.float64]:
    return np.array(values, np.float64).reshape([-1, *[1] * (-1 - channels)])


def _colour_axis(value: Array) -> int | None:
    """Return the axis of three colours, from the end; None if these are no pictures."""
    if value.ndim < 4:
        return None
    for axis, sides in ((-3, value.shape[-2:]), (-1, value.shape[-3:-1])):
        if value.shape[axis] == 3 and min(sides) >= SMALLEST_PICTURE:
            return axis
    return None


def camera_inputs(fed: Fed) -> list[tuple[str, int]]:
    """Return the inputs that have an axis of cameras, pictures first, and that axis."""
    arrays = fed.frames[0].arrays
    found = dict[str, int]()
    counts = set[int]()
    pictures = [name for name in arrays if _colour_axis(arrays[name]) is not None]
    for name in dict.fromkeys([*pictures, *arrays]):
        sides = arrays[name].shape[:2]
        axes = [
            axis
            for axis, count in reversed(list(enumerate(sides)))
            if 1 < count <= MOST_CAMERAS and (name in pictures or count in counts)
        ]
        if axes and arrays[name].ndim >= 3 and name not in fed.session.recurrent:
            found[name] = axes[0]
            counts.add(sides[axes[0]])
    return list(found.items())


def cameras_ordered(name: str, axis: int, order: tuple[int, ...]) -> InputFault:
    """Return the fault that feeds cameras in another order."""
    told = ", ".join(map(str, order))
    return InputFault(
        "cameras",
        f"input {name} has the cameras in another order: {told}",
        name,
        functools.partial(np.take, indices=order, axis=axis),
    )


def camera_orders(count: int) -> Iterator[tuple[int, ...]]:
    """Propose orders of cameras: swaps of two, turns, reversed, those of the field."""
    straight = tuple(range(count))
    yield from swaps(straight)
    for turn in range(1, count):
        yield (*straight[turn:], *straight[:turn])
    for turn in range(count):
        back = straight[::-1]
        yield (*back[turn:], *back[:turn])
    if count == len(CONVENTIONS[0]):
        for mine, theirs in itertools.permutations(CONVENTIONS, 2):
            yield tuple(mine.index(camera) for camera in theirs)


CONVENTIONS = (
    ("f", "fl", "fr", "b", "bl", "br"),  # VAD's and UniAD's agents in CARLA, ours
    ("f", "fr", "fl", "b", "bl", "br"),  # nuScenes in mmdetection3d, BEVFormer
    ("f", "fr", "fl", "b", "br", "bl"),  # left and right exchanged
    ("fl", "f", "fr", "bl", "b", "br"),  # pictures of nuScenes in two rows
    ("f", "fr", "br", "b", "bl", "fl"),  # clockwise
    ("f", "fl", "bl", "b", "br", "fr"),
)
"""Six cameras, front and back, left and right, as programs order them."""


def swaps(order: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Return an order with every two of its places exchanged."""
    for one, other in itertools.combinations(range(len(order)), 2):
        found = list(order)
        found[one], found[other] = found[other], found[one]
        yield tuple(found)
