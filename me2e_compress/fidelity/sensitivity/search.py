"""Choose the modules to make int8 under budgets of time, size and energy."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence

import onnx_ir as ir

from me2e_compress.display import significant
from me2e_compress.errors import EvaluationError
from me2e_compress.fidelity.sensitivity.analysis import (
    Int8Choice,
    Score,
    Trials,
    names_of,
)

MOST_MODULES = 16
"""All 2^16 assignments are weighed; a map of more modules must be coarser."""


@dataclasses.dataclass(frozen=True)
class Budget:
    """What a variant may cost.

    ``unit`` is that of the cost, e.g. ``bytes`` or ``s``; ``cost`` measures a graph.
    """

    limit: float
    unit: str
    cost: Callable[[ir.Model], float]


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One assignment: the modules that are int8, and what they cost.

    Attributes:
        loss: predicted: the root of the sum of squares of its modules' own losses, as
            errors of different modules are taken to be independent.
        costs: predicted, one per budget; those of the float model less what each module
            alone saves.
        score: measured; None, like the costs, if it was not tried.
        measured_costs: one per budget.
    """

    modules: tuple[str, ...]
    loss: float
    costs: tuple[float, ...]
    score: Score | None = None
    measured_costs: tuple[float, ...] | None = None


def search(
    trials: Trials,
    modules: Sequence[str],
    budgets: Sequence[Budget],
    *,
    most_tried: int = 8,
    progress: Callable[[int, int, str], None] | None = None,
) -> tuple[Candidate, ...]:
    """Find the assignment with the least loss within every budget.

    Every module is scored and weighed alone, which predicts all assignments. The best
    of those that should fit, at most ``most_tried``, are built, scored and weighed in
    turn until one does fit, the cheapest of all last. Returns what was tried, the fit
    last; ``progress`` is called with modules done and in all, and the next one.

    Raises:
        EvaluationError: too many modules, or nothing fits; it gives the least costs
            found.
    """
    active = [name for name in modules if names_of(trials, name)]
    if len(active) > MOST_MODULES:
        raise EvaluationError(
            f"{len(active)} modules are more than {MOST_MODULES}: use a coarser map"
        )
    # 1. every module alone: what it loses, what it saves
    whole = _costs(budgets, trials.model)
    losses, savings = {}, {}
    for done, name in enumerate(active):
        if progress:
            progress(done, len(active), name)
        losses[name] = trials.score(Int8Choice((name,))).loss
        alone = _costs(budgets, trials.variant(Int8Choice((name,))))
        savings[name] = tuple(a - b for a, b in zip(whole, alone, strict=True))
    # 2. every assignment, predicted from that
    ranked = _predict(active, losses, savings, whole)
    # 3. the best that should fit, measured until one does
    tried: list[Candidate] = []
    for candidate in _promising(ranked, budgets, most_tried):
        choice = Int8Choice(candidate.modules)
        costs = _costs(budgets, trials.variant(choice))
        score = trials.score(choice)
        tried.append(dataclasses.replace(candidate, score=score, measured_costs=costs))
        if _share(budgets, costs) <= 1:
            return tuple(tried)
    found = [each.costs for each in ranked]
    found += [each.measured_costs for each in tried if each.measured_costs]
    limits = [(each.limit, each.unit) for each in budgets]
    raise EvaluationError(nothing_fits(limits, whole, found))


def nothing_fits(
    limits: Sequence[tuple[float, str]],
    whole: Sequence[float],
    found: Sequence[Sequence[float]],
) -> str:
    """Return the message that nothing is within the budgets, with the least costs."""

    def said(costs: Iterable[float]) -> str:
        pairs = zip(costs, limits, strict=True)
        return " and ".join(
            f"{significant(cost, 6)} {unit}" for cost, (_, unit) in pairs
        )

    least = said(map(min, zip(*found, strict=True)))
    apart = "; each alone" if len(limits) > 1 else ""
    return (
        f"nothing fits {said(limit for limit, _ in limits)}: the float model costs"
        f" {said(whole)}, the least found is about {least}{apart}"
    )


def _costs(budgets: Sequence[Budget], made: ir.Model) -> tuple[float, ...]:
    return tuple(each.cost(made) for each in budgets)


def _share(budgets: Sequence[Budget], costs: Sequence[float]) -> float:
    """Return the share spent of the tightest budget; 1 is all of it."""
    return max(cost / budget.limit for cost, budget in zip(costs, budgets, strict=True))


def _promising(
    ranked: Sequence[Candidate], budgets: Sequence[Budget], most: int
) -> list[Candidate]:
    """Choose those predicted to fit, the best first and the cheapest of all last."""
    fitting = [each for each in ranked if _share(budgets, each.costs) <= 1]
    chosen = fitting[: most - 1]
    cheapest = min(ranked, key=lambda each: _share(budgets, each.costs))
    return chosen if not fitting or cheapest in chosen else [*chosen, cheapest]


def _predict(
    modules: Sequence[str],
    losses: dict[str, float],
    savings: dict[str, tuple[float, ...]],
    whole: tuple[float, ...],
) -> list[Candidate]:
    """Predict all assignments, sorted by loss, then by costs."""
    subsets = itertools.chain.from_iterable(
        itertools.combinations(modules, size) for size in range(len(modules) + 1)
    )
    found = [
        Candidate(
            subset,
            math.sqrt(sum(losses[name] ** 2 for name in subset)),
            tuple(
                cost - sum(savings[name][at] for name in subset)
                for at, cost in enumerate(whole)
            ),
        )
        for subset in subsets
    ]
    return sorted(found, key=lambda each: (each.loss, each.costs, each.modules))
