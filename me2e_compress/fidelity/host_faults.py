"""Name what went wrong on the host of an engine, outside of it.

Explanations are tried: the arithmetic of `me2e_compress.fidelity.dump_readings` on
outputs, then inferences of the graph, fed as a faulty host would have fed it
(`me2e_compress.fidelity.feed_faults`). One that brings the engine's answers to the
graph's is named. Inferences are made on the frames that tell most; what wins there must
win over all frames.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from me2e_compress.fidelity.dump_readings import (
    HIGHEST_DB,
    NAMED_DB,
    closeness,
    find_order,
    find_readings,
    sample,
)
from me2e_compress.fidelity.engine_run import Closeness, EngineRun
from me2e_compress.fidelity.feed_faults import (
    Fed,
    FeedFault,
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
MOST_GAIN_DB = 40.0
"""One output that comes right does not outweigh ten that get worse."""
MOST_FAULTS = 3
PROBES = 3
"""Frames that an explanation is tried on, and explanations that are tried on all."""


@dataclasses.dataclass(frozen=True)
class HostFault:
    """A fault outside the engine, and what naming it explains.

    Attributes:
        kind: In a word or two, for programs.
        said: As a sentence without its end.
        before_db: Mean closeness of the engine's answers to the graph's, over the
            outputs and frames that the fault touches; cut to -20 to 60 dB.
        after_db: The same, with the fault undone.
        frames: How many frames it touches.
        output: The output that is read wrongly; empty for what is fed.
        rivals: What explains the answers as well.
    """

    kind: str
    said: str
    before_db: float
    after_db: float
    frames: int
    output: str = ""
    rivals: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The fault and its evidence."""
        also = f"; or {'; or '.join(self.rivals)}" if self.rivals else ""
        return (
            f"host: {self.said}{also} ({self.before_db:.1f} dB become"
            f" {self.after_db:.1f} on {self.frames} frames)"
        )


def explain(run: EngineRun, pixels: Mapping[str, Pixels]) -> tuple[HostFault, ...]:
    """Find what went wrong on the host; the run then undoes it.

    Raises:
        EvaluationError: an output has a shape, or is not finite, and nothing explains
            it.
    """
    _find_readings(run)
    run.check()
    followed = run.follow()
    close, run.fed.own = followed.close, followed.own
    faults = list[HostFault]()
    for _ in range(MOST_FAULTS):
        if min(close.values(), default=HIGHEST_DB) >= HIGHEST_DB:
            break
        found = _find_cause(run, pixels, close) or _find_order(run, close)
        if found is None:
            break
        fault, close = found
        faults.append(fault)
        # what was hidden by this fault may be seen now
        if _find_readings(run):
            close = run.follow().close
    return (*faults, *_read_wrongly(run, close))


def _find_readings(run: EngineRun) -> bool:
    """Look for readings on frames that no state reaches; return whether one is new."""
    session, frames = run.fed.session, run.fed.frames
    starts = [at for at in range(1, len(run)) if frames[at].starts_scene][:1]
    if starts or len(run) == 1 or not session.recurrent:
        others = starts or list(range(1, len(run)))[-1:]
        return _read_anew(run, run.names, [0, *others])
    # in a single scene, state is what recurrent outputs say: they are read first
    states = [name for name in run.names if name in session.recurrent.values()]
    new = _read_anew(run, states, [0])
    if not run.fed.knows(1):
        next(run.fed.follow(run.causes, []))
        run.count()
    run.likes |= run.answer(0, ()) if not states else {}
    rest = [name for name in run.names if name not in states]
    return _read_anew(run, rest, [0, 1]) or new


def _read_anew(run: EngineRun, names: Sequence[str], shown: Sequence[int]) -> bool:
    truths = [run.answer(index, ()) for index in shown]
    run.likes |= truths[0]
    answered = [run.engine(index) for index in shown]
    new = False
    for name in names:
        likes, values = ([each[name] for each in all_] for all_ in (truths, answered))
        if min(map(closeness, likes, values)) < HIGHEST_DB:
            found = find_readings(values, likes)
            run.readings[name] = (*run.readings.get(name, ()), *found)
            new |= bool(found)
    return new


def _read_wrongly(run: EngineRun, close: Closeness) -> Iterator[HostFault]:
    """Name the readings that hold over all frames; the others are dropped."""
    if not any(run.readings.values()):
        return
    plain = dict[str, list[float]]()

    def watch(index: int, truth: Mapping[str, object], _: object) -> None:
        for name in run.names:
            right, raw = np.asarray(truth[name]), run.raw(index)[name]
            plain.setdefault(name, []).append(closeness(right, raw))

    with np.errstate(all="ignore"):  # as they stand, they may be any numbers
        run.follow(watch=watch)
    for name, readings in list(run.readings.items()):
        after = [close[name, index] for index in range(len(run))]
        gain = float(np.mean(after) - np.mean(plain[name]))
        fits = run.raw(0)[name].shape == run.likes[name].shape
        if not readings or (gain < NAMED_DB and fits):
            del run.readings[name]
            continue
        said = f"output {name} {' and '.join(each.said for each in readings)}"
        means = float(np.mean(plain[name])), float(np.mean(after))
        yield HostFault(readings[0].kind, said, *means, len(run), name)


def _find_cause(
    run: EngineRun, pixels: Mapping[str, Pixels], close: Closeness
) -> tuple[HostFault, Closeness] | None:
    """Name what was fed wrongly, and the closeness with it; None if nothing was."""
    contenders = list[tuple[float, FeedFault]]()
    named = {each.said for each in run.causes}
    for group in feed_faults(run.fed, pixels):
        fresh = [each for each in group if each.said not in named]
        contenders += _screened(run, fresh, close)
        if any(gain >= SURE_DB for gain, _ in contenders):
            break
    else:
        contenders += _camera_orders(run, close)
    contenders.sort(key=lambda each: -each[0])
    # the winner must win over all frames; so must what comes near it
    confirmed = list[tuple[float, FeedFault, Closeness, Fed]]()
    for gain, fault in contenders[:PROBES]:
        if confirmed and gain < contenders[0][0] - SCREENED_DB:
            break
        followed = run.follow([fault])
        found = _gain(close, followed.close)
        if found >= NAMED_DB:
            fed = dataclasses.replace(run.fed, own=followed.own)
            confirmed.append((found, fault, followed.close, fed))
    if not confirmed:
        return None
    best, fault, after, run.fed = max(confirmed, key=lambda each: each[0])
    run.causes = (*run.causes, fault)
    rivals = tuple(
        other.said
        for found, other, *_ in confirmed
        if other is not fault and found > best - TOUCHED_DB
    )
    return _fault(fault.kind, fault.said, close, after, rivals), after


def _fault(
    kind: str, said: str, close: Closeness, after: Closeness,
    rivals: tuple[str, ...] = (),
) -> HostFault:  # fmt: skip
    touched = _touched(close, after)
    means = (float(np.mean([by[at] for at in touched])) for by in (close, after))
    frames = len({index for _, index in touched})
    return HostFault(kind, said, *means, frames, rivals=rivals)


def _screened(
    run: EngineRun, faults: Sequence[FeedFault], close: Closeness
) -> list[tuple[float, FeedFault]]:
    """Return the faults that explain a few frames, with their gains in dB."""
    found = list[tuple[float, FeedFault]]()
    for fault in faults:
        after = dict[tuple[str, int], float]()
        for index in _telling(run, fault, close):
            after |= _tried(run, fault, index)
            if _gain(close, after) < SCREENED_DB:
                break
        if (gain := _gain(close, after)) >= SCREENED_DB:
            found.append((gain, fault))
    return found


def _tried(
    run: EngineRun, fault: FeedFault, index: int
) -> dict[tuple[str, int], float]:
    truth, answered = run.answer(index, [fault]), run.engine(index)
    return {
        (name, index): closeness(truth[name], answered[name]) for name in run.names
    }


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
    """Look for an order of cameras, by swaps from the best of the usual ones."""
    index = next(at for at in _worst_first(run, close) if run.fed.knows(at))
    found = list[tuple[float, FeedFault]]()
    for name, axis in camera_inputs(run.fed):
        straight = tuple(range(run.fed.frames[0].arrays[name].shape[axis]))
        best, tried = straight, {straight: TOUCHED_DB}
        orders = list(camera_orders(len(straight)))
        while orders:
            for order in dict.fromkeys(orders):
                if order not in tried:
                    fault = cameras_ordered(name, axis, order)
                    tried[order] = _gain(close, _tried(run, fault, index))
            leader = max(tried, key=lambda order: tried[order])
            orders = list(swaps(leader)) if leader != best else []
            best = leader
        if best != straight:
            found += _screened(run, [cameras_ordered(name, axis, best)], close)
        if any(gain >= SURE_DB for gain, _ in found):
            break
    return found


def _find_order(
    run: EngineRun, close: Closeness
) -> tuple[HostFault, Closeness] | None:
    """Look for another order of the dump's frames."""
    if run.order is not None or run.causes or len(run) < PROBES:
        return None
    # state that follows the frames as recorded, whatever the dump says
    own = Fed(run.fed.session, run.fed.frames, lambda index: {})
    truths = list[Mapping[str, object]]()
    for answers in own.follow((), run.names):
        run.count()
        truths.append(sample(answers))
    run.order = find_order(truths, [sample(run.engine(at)) for at in range(len(run))])
    if run.order is None:
        return None
    followed = run.follow()
    if _gain(close, followed.close) < NAMED_DB:
        run.order = None
        return None
    run.fed.own = followed.own
    said = run.order.said
    return _fault("frame-order", said, close, followed.close), followed.close


def _touched(before: Closeness, after: Closeness) -> list[tuple[str, int]]:
    """Return where an explanation moves the closeness of an output on a frame."""
    return [at for at in after if abs(after[at] - before[at]) >= TOUCHED_DB]


def _gain(before: Closeness, after: Closeness) -> float:
    """Return the mean gain in dB where an explanation says something; 0 if it is worse.

    Two of three outputs and frames that it touches must come nearer.
    """
    gains = np.array([after[at] - before[at] for at in _touched(before, after)])
    if len(gains) == 0 or np.mean(gains > 0) < 2 / 3:
        return 0.0
    return float(np.mean(np.clip(gains, -MOST_GAIN_DB, MOST_GAIN_DB)))
