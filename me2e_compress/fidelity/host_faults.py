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
    EXPLAINED_DB,
    HIGHEST_DB,
    NAMED_DB,
    closeness,
    find_readings,
)
from me2e_compress.fidelity.engine_run import Answers, Closeness, EngineRun
from me2e_compress.fidelity.fed import Fed, FeedFault
from me2e_compress.fidelity.feed_faults import Pixels
from me2e_compress.fidelity.feed_search import (
    PROBES,
    SURE_DB,
    find_explanations,
    gain_of,
    touched_by,
)
from me2e_compress.fidelity.frame_order import find_order, sample

NEAR_DB, EVIDENT_DB = 20.0, 10.0
"""How near an explanation must come for the order of frames not to be looked for, and
to be named at all."""
AS_GOOD_DB = 1.0
"""Explanations that differ by less over all frames are told together."""
MOST_FAULTS = 3


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
    run.check(run.names)
    followed = run.follow()
    close, run.fed.own = followed.close, followed.own
    faults = list[HostFault]()
    for _ in range(MOST_FAULTS):
        if min(close.values(), default=HIGHEST_DB) >= EXPLAINED_DB:
            break
        found = _find_fed(run, pixels, close)
        if found is None:
            break
        fault, close = found
        faults.append(fault)
        if fault.after_db >= EXPLAINED_DB:
            break
    # what was hidden by a fault may be seen now
    if faults and _find_readings(run):
        close = run.follow().close
    return (*faults, *_read_wrongly(run, close))


def _find_readings(run: EngineRun) -> bool:
    """Look for readings, on frames that no state reaches first; True if one is new."""
    frames = run.fed.frames
    starts = [at for at in range(1, len(run)) if frames[at].starts_scene][:2]
    # recurrent outputs first: other frames are fed what they say
    states = set(run.fed.session.recurrent.values())
    recurrent = [name for name in run.names if name in states]
    new = bool(recurrent) and _read_anew(run, recurrent, [0, *starts])
    run.check(recurrent)
    if len(run) > 1 and not run.fed.knows(1):
        next(run.fed.follow(run.causes, []))
        run.count()
    others = [at for at in (1, len(run) // 2 + 1, len(run) - 1) if at < len(run)]
    known = [at for at in others if run.fed.knows(at)][-2:]
    return _read_anew(run, run.names, [*dict.fromkeys([0, *starts, *known])]) or new


def _read_anew(run: EngineRun, names: Sequence[str], shown: Sequence[int]) -> bool:
    truths = [run.answer(index, ()) for index in shown]
    run.likes |= truths[0]
    answered = [run.engine(index) for index in shown]
    new = False
    for name in names:
        likes, values = ([each[name] for each in all_] for all_ in (truths, answered))
        if min(map(closeness, likes, values)) < EXPLAINED_DB:
            found = find_readings(values, likes)
            run.readings[name] = (*run.readings.get(name, ()), *found)
            new |= bool(found)
    return new


def _read_wrongly(run: EngineRun, close: Closeness) -> Iterator[HostFault]:
    """Name the readings that hold over all frames; the others are dropped."""
    if not any(run.readings.values()):
        return
    plain = dict[str, list[float]]()

    def watch(index: int, truth: Answers, _: Answers) -> None:
        for name in run.names:
            right, raw = truth[name], run.raw(index)[name]
            plain.setdefault(name, []).append(closeness(right, raw))

    with np.errstate(all="ignore"):  # as they stand, they may be any numbers
        run.follow(watch=watch)
    for name, readings in list(run.readings.items()):
        after = [close[name, index] for index in range(len(run))]
        means = float(np.mean(plain[name])), float(np.mean(after))
        fits = run.raw(0)[name].shape == run.likes[name].shape
        # ranks that int8 changes are an order, too, which explains little
        shown = means[1] - means[0] >= NAMED_DB and means[1] >= EVIDENT_DB
        if not readings or (fits and not shown):
            del run.readings[name]
            # a reading that is dropped may have hidden what is not finite
            run.check([name])
            continue
        said = f"output {name} {' and '.join(each.said for each in readings)}"
        yield HostFault(readings[0].kind, said, *means, len(run), name)


def _find_fed(
    run: EngineRun, pixels: Mapping[str, Pixels], close: Closeness
) -> tuple[HostFault, Closeness] | None:
    """Name what was fed wrongly, or in which order frames were dumped."""
    before = run.causes, run.fed
    found = _find_cause(run, pixels, close)
    if found is not None and found[0].after_db >= NEAR_DB:
        return found
    after = run.causes, run.fed
    run.causes, run.fed = before
    ordered = _find_order(run, close)
    if ordered is None and found is not None:
        gained = found[0].after_db - found[0].before_db
        run.causes, run.fed = after
        if found[0].after_db >= EVIDENT_DB or gained >= SURE_DB:
            return found
        run.causes, run.fed = before
        return None
    return ordered


def _find_cause(
    run: EngineRun, pixels: Mapping[str, Pixels], close: Closeness
) -> tuple[HostFault, Closeness] | None:
    """Name what was fed wrongly, and the closeness with it; None if nothing was."""
    proposed = find_explanations(run, pixels, close)
    screened = sorted(proposed, key=lambda each: -each[0])[:PROBES]
    # the winner must win over all frames
    confirmed = list[tuple[float, FeedFault, Closeness, Fed]]()
    for _, fault in screened:
        followed = run.follow([fault])
        if gain_of(close, followed.close) >= NAMED_DB:
            fed = dataclasses.replace(run.fed, own=followed.own)
            # what explains more frames explains more
            found = float(np.mean(list(followed.close.values())))
            confirmed.append((found, fault, followed.close, fed))
    if not confirmed:
        return None
    # of what explains as much, what was proposed first is named: it is more common
    best = max(found for found, *_ in confirmed)
    order = {fault.said: at for at, (_, fault) in enumerate(proposed)}
    equal = [each for each in confirmed if each[0] > best - AS_GOOD_DB]
    equal.sort(key=lambda each: order[each[1].said])
    _, fault, after, run.fed = equal[0]
    run.causes = (*run.causes, fault)
    rivals = tuple(other.said for _, other, *_ in equal[1:])
    return _fault(fault.kind, fault.said, close, after, rivals), after


def _fault(
    kind: str, said: str, close: Closeness, after: Closeness,
    rivals: tuple[str, ...] = (),
) -> HostFault:  # fmt: skip
    touched = touched_by(close, after)
    before_db, after_db = (
        float(np.mean([by[at] for at in touched])) for by in (close, after)
    )
    frames = len({index for _, index in touched})
    return HostFault(kind, said, before_db, after_db, frames, rivals=rivals)


def _find_order(run: EngineRun, close: Closeness) -> tuple[HostFault, Closeness] | None:
    """Look for another order of the dump's frames."""
    if run.order is not None or run.causes or len(run) < PROBES:
        return None
    # state that follows the frames as recorded, whatever the dump says
    own = Fed(run.fed.session, run.fed.frames, lambda index: {})
    truths = list[Answers]()
    for answers in own.follow((), run.names):
        run.count()
        truths.append(sample(answers))
    run.order = find_order(truths, [sample(run.engine(at)) for at in range(len(run))])
    if run.order is None:
        return None
    followed = run.follow()
    if gain_of(close, followed.close) < NAMED_DB:
        run.order = None
        return None
    run.fed.own = followed.own
    said = run.order.said
    return _fault("frame-order", said, close, followed.close), followed.close
