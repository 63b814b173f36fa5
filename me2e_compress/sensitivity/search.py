"""Which modules to make int8 under a budget of time or size."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import onnx_ir as ir

from me2e_compress.errors import EvaluationError
from me2e_compress.sensitivity.analysis import names_of
from me2e_compress.sensitivity.trials import Int8Choice, Score, Trials

MOST_MODULES = 16
"""All 2^16 assignments are weighed; a map of more modules must be coarser."""


@dataclasses.dataclass(frozen=True)
class Budget:
    """What a variant may cost.

    Attributes:
        limit: the most it may cost.
        unit: of the cost, e.g. ``bytes`` or ``s``.
        cost: measures a graph.
    """

    limit: float
    unit: str
    cost: Callable[[ir.Model], float]


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One assignment.

    Attributes:
        modules: those that are int8.
        loss: predicted: the losses of its modules alone, squared and added, the root
            of that: errors of different modules are taken to be independent.
        cost: predicted: that of the float model less what each module alone saves.
        score: measured; None where it was not tried.
        measured_cost: measured; None where it was not tried.
    """

    modules: tuple[str, ...]
    loss: float
    cost: float
    score: Score | None = None
    measured_cost: float | None = None


def search(
    trials: Trials,
    modules: Sequence[str],
    budget: Budget,
    *,
    most_tried: int = 8,
    progress: Callable[[int, int, str], None] | None = None,
) -> tuple[Candidate, ...]:
    """Find the assignment that loses least within a budget.

    Every module is scored and weighed alone; all assignments are predicted from that,
    and the best of those that should fit are built, scored and weighed in turn until
    one does fit; the last that is tried is the cheapest of all.

    Returns:
        What was tried; the last one fits.

    Raises:
        EvaluationError: too many modules, or nothing fits; the message gives the least
            cost that was found.
    """
    active = [name for name in modules if names_of(trials, name)]
    if len(active) > MOST_MODULES:
        raise EvaluationError(
            f"{len(active)} modules are more than {MOST_MODULES}: use a coarser map"
        )
    # 1. every module alone: what it loses, what it saves
    float_cost = budget.cost(trials.model)
    losses, savings = {}, {}
    for done, name in enumerate(active):
        if progress:
            progress(done, len(active), name)
        losses[name] = trials.score(Int8Choice((name,))).loss
        savings[name] = float_cost - budget.cost(trials.variant(Int8Choice((name,))))
    # 2. every assignment, predicted from that
    ranked = _predict(active, losses, savings, float_cost)
    # 3. the best that should fit, measured until one does
    tried: list[Candidate] = []
    least = min(each.cost for each in ranked)
    for candidate in _promising(ranked, budget.limit, most_tried):
        choice = Int8Choice(candidate.modules)
        cost = budget.cost(trials.variant(choice))
        score, least = trials.score(choice), min(least, cost)
        tried.append(dataclasses.replace(candidate, score=score, measured_cost=cost))
        if cost <= budget.limit:
            return tuple(tried)
    raise EvaluationError(
        f"nothing fits {budget.limit:g} {budget.unit}: the float model costs"
        f" {float_cost:g}, the cheapest assignment about {least:g}"
    )


def _promising(ranked: Sequence[Candidate], limit: float, most: int) -> list[Candidate]:
    """Choose those predicted to fit, the best first and the cheapest of all last."""
    fitting = [each for each in ranked if each.cost <= limit]
    chosen = fitting[: most - 1]
    cheapest = min(ranked, key=lambda each: each.cost)
    return chosen if not fitting or cheapest in chosen else [*chosen, cheapest]


def _predict(
    modules: Sequence[str],
    losses: dict[str, float],
    savings: dict[str, float],
    float_cost: float,
) -> list[Candidate]:
    """Predict all assignments, the least loss first, then the least cost."""
    subsets = itertools.chain.from_iterable(
        itertools.combinations(modules, size) for size in range(len(modules) + 1)
    )
    found = [
        Candidate(
            subset,
            math.sqrt(sum(losses[name] ** 2 for name in subset)),
            float_cost - sum(savings[name] for name in subset),
        )
        for subset in subsets
    ]
    return sorted(found, key=lambda each: (each.loss, each.cost, each.modules))
