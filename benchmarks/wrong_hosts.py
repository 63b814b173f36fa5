"""Seeded faults of a host: each feeds an engine, or reads its outputs, wrongly.

Each is written here anew, without the code that explains it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from me2e_compress.runtime.frames import Frame

Arrays: TypeAlias = dict[str, Any]
Change: TypeAlias = Callable[[Any], Any]
MIRRORED = (0, 2, 1, 3, 5, 4)
"""Left and right cameras exchanged."""
MIXED = (2, 0, 1, 5, 3, 4)
STATISTICS = {
    "highway": ((110.0,) * 3, (60.0,) * 3),
    "vad-tiny": ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
}
SLOT_AXIS = {"highway": 1, "vad-tiny": 2}


@dataclass(frozen=True)
class Host:
    """A host with one fault, or none.

    Attributes:
        names: Kinds of faults that name it rightly, the first of them as it is meant.
        feed: What becomes of the inputs of a frame, given all frames and its index.
        state: The state of a frame, given the first one, whether a scene starts, and
            the states after all frames before.
        read: What becomes of the outputs, as they are dumped.
        order: Which frame's answers are dumped under a frame.
    """

    names: tuple[str, ...]
    feed: Callable[[Sequence[Frame], int], Arrays] = lambda frames, at: (
        frames[at].arrays
    )
    state: Callable[[Arrays, bool, list[Arrays]], Arrays] = (
        lambda first, starts, before: first if starts else before[-1]
    )
    read: Callable[[Arrays], Arrays] = lambda outputs: outputs
    order: Callable[[int], list[int]] = lambda count: list(range(count))


def changed(name: str, change: Change) -> Any:
    def feed(frames: Sequence[Frame], at: int) -> Arrays:
        arrays = frames[at].arrays
        value = arrays[name]
        return arrays | {name: np.ascontiguousarray(change(value)).astype(value.dtype)}

    return feed


def from_other(name: str | None, other: Callable[[int], int]) -> Any:
    def feed(frames: Sequence[Frame], at: int) -> Arrays:
        found = frames[max(0, min(other(at), len(frames) - 1))].arrays
        mine = frames[at].arrays
        return dict(found) if name is None else mine | {name: found[name]}

    return feed


def reading(name: str, change: Change) -> Any:
    return lambda outputs: outputs | {name: change(outputs[name])}


def late(first: Arrays, starts: bool, before: list[Arrays]) -> Arrays:
    return first if starts or len(before) < 2 else before[-2]


def carried(first: Arrays, starts: bool, before: list[Arrays]) -> Arrays:
    return before[-1] if before else first


def never(first: Arrays, starts: bool, before: list[Arrays]) -> Arrays:
    return first


def hosts(stack: str) -> dict[str, Host]:
    """Return the seeded faults by name."""
    on_vad = stack != "highway"
    image = "img"
    mean, std = (
        np.array(each, np.float32).reshape(3, 1, 1) for each in STATISTICS[stack]
    )
    large = "bev_embed" if on_vad else "occupancy"
    small = "ego_fut_preds" if on_vad else "plan"
    slots = "all_bbox_preds" if on_vad else "boxes"
    motion = "can_bus"
    geometry = "lidar2img"

    def shuffled(value: Any) -> Any:
        axis = SLOT_AXIS[stack]
        order = np.random.default_rng(3).permutation(value.shape[axis])
        return np.take(value, order, axis=axis)

    def channels_last(value: Any) -> Any:
        channels = next(at for at, size in enumerate(value.shape) if size > 1)
        return np.moveaxis(value, channels, -1).copy()

    def blue_first(value: Any) -> Any:
        return ((value * std + mean)[:, :, ::-1] - mean) / std

    def half_filled(value: Any) -> Any:
        halves = np.resize(value.astype(np.float16), 2 * value.size)
        return halves.view(np.float32).reshape(value.shape)

    def as_text(count: int) -> list[int]:
        straight = list(range(count))
        return sorted(straight, key=str) if count > 10 else straight[::-1]

    return {
        "none": Host(("",)),
        "state carried over scenes": Host(("state-not-reset",), state=carried),
        "state one frame stale": Host(("state-late",), state=late),
        "state never fed": Host(("state-never-fed",), state=never),
        "images of 0 to 1": Host(
            ("normalisation",),
            changed(image, lambda x: ((x * std + mean) / 255 - mean) / std),
        ),
        "images not normalised": Host(
            ("normalisation",), changed(image, lambda x: x * std + mean)
        ),
        "mean missing": Host(
            ("normalisation",), changed(image, lambda x: x + mean / std)
        ),
        "red and blue swapped": Host(("colours",), changed(image, blue_first)),
        "channels last": Host(
            ("input-layout",),
            changed(image, lambda x: np.moveaxis(x, 2, -1).copy().reshape(x.shape)),
        ),
        "left and right cameras": Host(
            ("cameras",), changed(image, lambda x: x[:, list(MIRRORED)])
        ),
        "cameras mixed": Host(
            ("cameras",), changed(image, lambda x: x[:, list(MIXED)])
        ),
        "matrices transposed": Host(
            ("input-layout",), changed(geometry, lambda x: x.swapaxes(-1, -2))
        ),
        "ego status stuck": Host(("input-stuck",), from_other(motion, lambda at: 0)),
        "command stuck": Host(("input-stuck",), from_other("command", lambda at: 0)),
        "images one frame late": Host(
            ("input-late",), from_other(image, lambda at: at - 1)
        ),
        "ego status never fed": Host(
            ("input-never-fed",), changed(motion, np.zeros_like)
        ),
        "frames shifted by one": Host(
            ("frames-shifted",), from_other(None, lambda at: at - 1)
        ),
        "frames sorted as text": Host(("frame-order",), order=as_text),
        "float32 read as int32": Host(
            ("dtype",), read=reading(small, lambda x: x.view(np.int32))
        ),
        "float16 read as float32": Host(
            ("dtype",),
            read=reading(large, half_filled),
        ),
        "big endian": Host(("dtype",), read=reading(small, lambda x: x.byteswap())),
        "output channels last": Host(("layout",), read=reading(large, channels_last)),
        "output transposed but shaped as before": Host(
            ("layout",),
            read=reading(large, lambda x: channels_last(x).reshape(x.shape)),
        ),
        "output flat": Host(("layout",), read=reading(small, lambda x: x.reshape(-1))),
        "slots in another order": Host(("slots",), read=reading(slots, shuffled)),
        "output scaled": Host(("scale",), read=reading(large, lambda x: x * 0.5)),
    }
