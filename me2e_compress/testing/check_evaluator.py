"""Check that an evaluator yields what scores are computed from."""

import itertools
import json
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

from me2e_compress.base.errors import EvaluationError, VerificationError
from me2e_compress.base.listener import SILENT
from me2e_compress.driving.latency import FixedLatency
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators import EVALUATORS, Drive, Evaluator
from me2e_compress.evaluators.contract import with_abilities
from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import is_route_id
from me2e_compress.testing.form import check_form, require

# What every decision is charged where an evaluator declares that it takes latency
LATENCY_US = 250_000


def check_evaluator(
    evaluator: Evaluator, policy: Driver | None = None, routes: str = "all"
) -> tuple[Episode, ...]:
    """Check that an evaluator does what it declares, and always the same.

    It passes :func:`check_form` and has what its ``takes`` declares; it yields at least
    one episode, each of the routes that were asked for and no route twice; a second
    evaluation yields equal episodes; a latency is charged to decisions; and episodes
    can be stored: a route's name is valid in a file name, its numbers are finite and in
    their bounds, its frames are in order of time.

    ``policy`` is who drives, None for an evaluator that reads; ``routes`` are words of
    the evaluator, which it is asked for if it takes routes. Returns the episodes.

    Raises:
        VerificationError: it broke a promise; the message says which.
        EvaluationError: it cannot evaluate.
    """
    check_form(evaluator, EVALUATORS)
    name, drive = evaluator.name, Drive()
    try:
        with_abilities(evaluator)
    except EvaluationError as error:
        raise VerificationError(str(error)) from error
    size: object = evaluator.set_size
    require(isinstance(size, int), f"{name}: set_size is no property of a number")
    if "routes" in evaluator.takes:
        picked, set_size = evaluator.routes(routes)
        drive = replace(drive, routes=picked, set_size=set_size)
    # episodes, each of its own route, that can be stored
    first = _episodes(evaluator, policy, drive)
    for episode in first:
        _check_storable(name, episode)
    # the same again
    second = _episodes(evaluator, policy, drive)
    if [e.route for e in second] != [e.route for e in first]:
        raise VerificationError(f"{name} yields other routes, or in another order")
    for one, other in zip(first, second, strict=True):
        words = f"two runs of {name} give different episodes for {one.route}"
        require(one == other, words)
    if "latency" in evaluator.takes:
        late = replace(drive, latency=FixedLatency(LATENCY_US))
        for episode in _episodes(evaluator, policy, late):
            charged = {decision.latency_us for decision in episode.decisions}
            words = f"{name} declares latency, and does not charge it on"
            require(charged == {LATENCY_US}, f"{words} {episode.route}")
    return first


def _episodes(
    evaluator: Evaluator, policy: Driver | None, drive: Drive
) -> tuple[Episode, ...]:
    """Return an episode for each route asked for, in that order; else refuse."""
    name = evaluator.name
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder) / "results"
        episodes = tuple(evaluator.episodes(policy, drive, results, SILENT))
    require(episodes, f"{name} yields no episode")
    strange = [e for e in episodes if not isinstance(e, Episode)]
    if strange:
        raise VerificationError(f"{name} yields {strange[0]!r}, no episode")
    route, count = Counter(episode.route for episode in episodes).most_common(1)[0]
    require(count == 1, f"{name} yields route {route} {count} times")
    if not drive.routes:
        return episodes
    wanted = [route.id for route in drive.routes]
    if sorted(wanted) != sorted(episode.route for episode in episodes):
        raise VerificationError(f"{name} yields other routes than were asked for")
    return tuple(sorted(episodes, key=lambda episode: wanted.index(episode.route)))


def _check_storable(name: str, episode: Episode) -> None:
    """Check a route's id, the round trip through JSON, and the order of frames."""
    route = episode.route
    words = "a name is made of letters, digits, '_' and '-'"
    require(is_route_id(route), f"{name} yields route {route!r}: {words}")
    # the episode survives its JSON
    try:
        again = Episode.from_json(json.loads(json.dumps(episode.to_json())))
    except (TypeError, ValueError) as error:
        line = " ".join(str(error).split())[:200]
        raise VerificationError(f"{name}: {route} cannot be kept: {line}") from error
    require(again == episode, f"{name}: {route} is read back as another episode")
    # frames are in order
    times = [frame.time_us for frame in episode.frames]
    ordered = all(early < late for early, late in itertools.pairwise(times))
    require(ordered, f"{name}: the frames of {route} are not in their order")
