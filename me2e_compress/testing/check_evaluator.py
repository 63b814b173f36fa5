"""Check that an evaluator yields what scores are computed from."""

import itertools
import json
from collections import Counter

from me2e_compress.driving.contract import Evaluator, SizedEvaluator
from me2e_compress.errors import VerificationError
from me2e_compress.evaluators import EVALUATORS
from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import is_route_id
from me2e_compress.testing.form import check_form, require


def check_evaluator(
    evaluator: Evaluator, again: Evaluator | None = None
) -> tuple[Episode, ...]:
    """Check that an evaluator yields each route once, and always the same.

    It passes :func:`check_form`; it yields at least one episode, no route twice; a
    second evaluation yields equal episodes in the same order; and episodes can be
    stored: a route's name is valid in a file name, its numbers are finite and in their
    bounds, its frames are in order of time.

    ``again`` has equal options and drives anew, i.e. with another folder for results;
    None asks the same evaluator twice. Returns the episodes.

    Raises:
        VerificationError: it broke a promise; the message says which.
        EvaluationError: it cannot evaluate.
    """
    check_form(evaluator, EVALUATORS)
    name = evaluator.name
    if isinstance(evaluator, SizedEvaluator):
        size: object = evaluator.set_size
        require(isinstance(size, int), f"{name}: set_size is no property of a number")
    first = tuple(evaluator.episodes())
    require(first, f"{name} yields no episode")
    # episodes, each of its own route, that can be stored
    for each in first:
        require(isinstance(each, Episode), f"{name} yields {each!r}, no episode")
    route, count = Counter(each.route for each in first).most_common(1)[0]
    require(count == 1, f"{name} yields route {route} {count} times")
    for each in first:
        _check_kept(name, each)
    # the same again
    second = tuple((evaluator if again is None else again).episodes())
    routes = [[each.route for each in episodes] for episodes in (first, second)]
    same = routes[0] == routes[1]
    require(same, f"{name} yields other routes, or in another order")
    for one, other in zip(first, second, strict=True):
        differ = f"two runs of {name} give different episodes for {one.route}"
        require(one == other, differ)
    return first


def _check_kept(name: str, episode: Episode) -> None:
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
