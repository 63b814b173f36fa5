"""Evaluators beside highway-env: built from text, their episodes kept as results."""

from collections.abc import Mapping
from pathlib import Path

from me2e_compress.driving.contract import Evaluator, SizedEvaluator
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators import EVALUATORS
from me2e_compress.evaluators.highway.results import ResultsFolder
from me2e_compress.metrics.episode import Episode
from me2e_compress.registry import name_in, options_of
from me2e_compress.simulator.routes import is_route_id
from me2e_compress.version import __version__

HIGHWAY = "highway"
POLICY = "policy"
"""The option by which an evaluator receives the policy that it drives."""


def is_highway(text: str) -> bool:
    """Return whether a text names highway, which takes no options here."""
    if name_in(text) != HIGHWAY:
        return False
    if text.strip() != HIGHWAY:
        raise EvaluationError(
            f"{text}: highway's options are the command's own: --routes, --latency, ..."
        )
    return True


def evaluator_named(text: str, policy: str | None = None) -> Evaluator:
    """Build an evaluator from ``name`` or ``name{option=value}``.

    The policy, if any, becomes its option ``policy``; an evaluator without that option
    raises EvaluationError.
    """
    more: Mapping[str, object] = {} if policy is None else {POLICY: policy}
    name = name_in(text)
    if policy is not None and name in EVALUATORS.names():
        options = {each.name for each in options_of(EVALUATORS.get(name))}
        if POLICY not in options:
            raise EvaluationError(f"{name} drives no policy: leave out {policy}")
    return EVALUATORS.parse(text, more=more)


def files_of(evaluator: Evaluator) -> list[Path]:
    """Return the files and folders that an evaluator's options name."""
    values = [getattr(evaluator, each.name) for each in options_of(type(evaluator))]
    return [value for value in values if isinstance(value, Path)]


def expected_of(evaluator: Evaluator, episodes: tuple[Episode, ...]) -> int:
    """Return how many routes an evaluator's whole set has."""
    if isinstance(evaluator, SizedEvaluator):
        return max(evaluator.set_size, len(episodes))
    return len(episodes)


def driven_episodes(evaluator: Evaluator) -> tuple[Episode, ...]:
    """Return all episodes of an evaluator, after checking that each can be kept.

    At least one is needed, routes must differ, and their names must fit files.
    """
    episodes = tuple(evaluator.episodes())
    if not episodes:
        raise EvaluationError(f"{evaluator.name} yields no episode")
    seen = set[str]()
    for each in episodes:
        if not is_route_id(each.route):
            raise EvaluationError(
                f"{evaluator.name} yields route {each.route[:60]!r}: a name is made of "
                "letters, digits, '_' and '-'"
            )
        if each.route in seen:
            raise EvaluationError(f"{evaluator.name} yields route {each.route} twice")
        seen.add(each.route)
    return episodes


def keep(
    evaluator: Evaluator, episodes: tuple[Episode, ...], folder: Path, driver: str = ""
) -> None:
    """Write episodes as a folder of results, which ``score`` reads."""
    made_by = {
        "version": __version__,
        "evaluator": EVALUATORS.text(evaluator),
        "policy": driver,
        "set_size": expected_of(evaluator, episodes),
        "routes": [each.route for each in episodes],
    }
    results = ResultsFolder.create(folder, made_by)
    for each in episodes:
        results.keep(each)


def kept(evaluator: Evaluator, folder: Path, driver: str) -> tuple[Episode, ...] | None:
    """Return the complete episodes kept by the same evaluator and driver, else None."""
    try:
        results = ResultsFolder.open(folder)
    except EvaluationError:
        return None
    # episodes of another version or evaluator are not reused, nor parts of a set
    wanted = {
        "version": __version__,
        "evaluator": EVALUATORS.text(evaluator),
        "policy": driver,
    }
    if any(results.made_by.get(key) != value for key, value in wanted.items()):
        return None
    found = results.episodes()
    whole = len(found) == len(results.made_by["routes"])
    return tuple(found.values()) if whole else None
