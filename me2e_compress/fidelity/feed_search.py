"""Try what a host may have fed an engine, on the frames that tell most."""

from collections.abc import Mapping, Sequence

import numpy as np

from me2e_compress.fidelity.dump_readings import closeness
from me2e_compress.fidelity.engine_run import Closeness, EngineRun
from me2e_compress.fidelity.fed import FeedFault
from me2e_compress.fidelity.feed_faults import (
    Pixels,
    camera_inputs,
    camera_orders,
    cameras_ordered,
    feed_faults,
    swaps,
)

TOUCHED_DB = 0.5
"""An explanation says something of an output that it moves so much nearer or away."""
SCREENED_DB = 3.0
"""What an explanation takes from the residual of one frame to be tried on more."""
SURE_DB = 15.0
"""What an explanation takes from the residual for rarer ones not to be looked for."""
CAMERAS_DB = 30.0
"""Where the worst frame is nearer, cameras are in order: their orders are many."""
MOST_GAIN_DB = 40.0
"""One output that comes right does not outweigh ten that get worse."""
PROBES = 3
"""Frames that an explanation is tried on, and explanations that are tried on all."""


def find_explanations(
    run: EngineRun, pixels: Mapping[str, Pixels], close: Closeness
) -> list[tuple[float, FeedFault]]:
    """Return what explains a few frames, with gains in dB; the common ones first."""
    found = list[tuple[float, FeedFault]]()
    named = {each.said for each in run.causes}
    for nth, group in enumerate(feed_faults(run.fed, pixels)):
        fresh = [each for each in group if each.said not in named]
        found += _screened(run, fresh, close)
        # frames that are shifted look like a state that is not reset: try both
        if nth > 0 and any(gained >= SURE_DB for gained, _ in found):
            break
    else:
        found += _camera_orders(run, close)
    return found


def _screened(
    run: EngineRun, faults: Sequence[FeedFault], close: Closeness
) -> list[tuple[float, FeedFault]]:
    """Return the faults that explain a few frames, with their gains in dB."""
    found = list[tuple[float, FeedFault]]()
    for fault in faults:
        after = dict[tuple[str, int], float]()
        for index in _telling(run, fault, close):
            after |= _tried(run, fault, index)
            if gain_of(close, after) < SCREENED_DB:
                break
        if (gain := gain_of(close, after)) >= SCREENED_DB:
            frames = {index for _, index in after}
            found.append((gain * len(frames) / PROBES, fault))
    return found


def _tried(
    run: EngineRun, fault: FeedFault, index: int
) -> dict[tuple[str, int], float]:
    truth, answered = run.answer(index, [fault]), run.engine(index)
    return {(name, index): closeness(truth[name], answered[name]) for name in run.names}


def _telling(run: EngineRun, fault: FeedFault, close: Closeness) -> list[int]:
    """Return the frames that a fault touches, those with the worst answers first."""
    found = list[int]()
    for index in _worst_first(run, close):
        if run.fed.knows(index) and fault.touches(run.fed, index):
            found.append(index)
        if len(found) == PROBES:
            break
    return found


def _worst_first(run: EngineRun, close: Closeness) -> list[int]:
    means = [
        float(np.mean([close[name, index] for name in run.names]))
        for index in range(len(run))
    ]
    return sorted(range(len(means)), key=lambda index: means[index])


def _camera_orders(run: EngineRun, close: Closeness) -> list[tuple[float, FeedFault]]:
    """Look for an order of cameras, by swaps from the best of the usual ones.

    Where pictures come in an order, matrices in the opposite one may explain as much.
    """
    index = next(at for at in _worst_first(run, close) if run.fed.knows(at))
    if np.mean([close[name, index] for name in run.names]) >= CAMERAS_DB:
        return []
    found = camera_inputs(run.fed)
    if not found:
        return []
    (name, axis), *others = found
    straight = tuple(range(run.fed.frames[0].arrays[name].shape[axis]))
    best, tried = straight, {straight: TOUCHED_DB}
    orders = list(camera_orders(len(straight)))
    while orders:
        for order in dict.fromkeys(orders):
            if order not in tried:
                fault = cameras_ordered(name, axis, order)
                tried[order] = gain_of(close, _tried(run, fault, index))
        leader = max(tried, key=lambda order: tried[order])
        orders = list(swaps(leader)) if leader != best else []
        best = leader
    if best == straight:
        return []
    back = tuple(int(at) for at in np.argsort(best))
    faults = [cameras_ordered(name, axis, best)]
    faults += [cameras_ordered(other, at, back) for other, at in others]
    return _screened(run, faults, close)


def touched_by(before: Closeness, after: Closeness) -> list[tuple[str, int]]:
    """Return where an explanation moves the closeness of an output on a frame."""
    return [at for at in after if abs(after[at] - before[at]) >= TOUCHED_DB]


def gain_of(before: Closeness, after: Closeness) -> float:
    """Return the mean gain in dB where an explanation says something; 0 if it is worse.

    Two of three outputs and frames that it touches must come nearer.
    """
    gains = np.array([after[at] - before[at] for at in touched_by(before, after)])
    if len(gains) == 0 or np.mean(gains > 0) < 2 / 3:
        return 0.0
    return float(np.mean(np.clip(gains, -MOST_GAIN_DB, MOST_GAIN_DB)))
