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
"""The option by which an evaluator that drives a policy gets it."""


def is_highway(text: str) -> bool:
    """Return whether a text names the evaluator that commands have options for.

    Raises:
        EvaluationError: It gives that evaluator options, which the command has itself.
    """
    if name_in(text) != HIGHWAY:
        return False
    if text.strip() != HIGHWAY:
        raise EvaluationError(
            f"{text}: highway's options are the command's own: --routes, --latency, ..."
        )
    return True


def evaluator_named(text: str, policy: str | None = None) -> Evaluator:
    """Build an evaluator from ``name`` or ``name{option=value}``.

    Args:
        text: Of the evaluator.
        policy: Who drives; it becomes the option ``policy``.

    Raises:
        EvaluationError: No such evaluator or option, or a policy for one that drives
            none, or given twice.
    """
    more: Mapping[str, object] = {} if policy is None else {POLICY: policy}
    name = name_in(text)
    if policy is not None and name in EVALUATORS.names():
        options = {each.name for each in options_of(EVALUATORS.get(name))}
        if POLICY not in options:
            raise EvaluationError(f"{name} drives no policy: leave out {policy}")
    return EVALUATORS.parse(text, more=more)


def files_of(evaluator: Evaluator) -> list[Path]:
    """List the files and folders that an evaluator's options name."""
    values = [getattr(evaluator, each.name) for each in options_of(type(evaluator))]
    return [value for value in values if isinstance(value, Path)]


def expected_of(evaluator: Evaluator, episodes: tuple[Episode, ...]) -> int:
    """Return how many routes an evaluator's whole set has."""
    if isinstance(evaluator, SizedEvaluator):
        return max(evaluator.set_size, len(episodes))
    return len(episodes)


def driven_episodes(evaluator: Evaluator) -> tuple[Episode, ...]:
    """Return all episodes of an evaluator, each of which can be kept.

    Raises:
        EvaluationError: It yields none, a route twice, or one whose name cannot be that
            of a file; or it cannot evaluate.
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
    """Write episodes as a folder of results, which ``score`` reads.

    Args:
        evaluator: That yielded them.
        episodes: One a route.
        folder: Where they go.
        driver: What identifies the policy.

    Raises:
        EvaluationError: The folder holds the results of another evaluation, or cannot
            be written.
    """
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
    """Return the episodes that were kept of the same evaluator and driver.

    Args:
        evaluator: That would yield them.
        folder: Where they went.
        driver: What identifies the policy.
    """
    try:
        results = ResultsFolder.open(folder)
    except EvaluationError:
        return None
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
