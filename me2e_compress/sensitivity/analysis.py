"""Measure the loss of int8 module by module, and find the nodes to blame."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Generic, TypeVar

from me2e_compress.quantization.plan import RESIDUAL
from me2e_compress.sensitivity.trials import Int8Choice, Score, Trials

Item = TypeVar("Item")

BLAME = 0.5
"""Nodes are to blame if they alone cost this part of what their module costs."""


@dataclasses.dataclass(frozen=True)
class ModuleSensitivity:
    """The loss of one module when it alone is int8.

    Attributes:
        nodes: int8 nodes then.
        driving: driving score; None if nothing is driven.
        blamed: groups of nodes with their losses; worst first. A single node was
            found by bisection; a larger group is costly only together, or was left
            whole when the trials were used up. It is empty if the loss is spread over
            the module.
    """

    module: str
    nodes: int
    score: Score
    driving: float | None = None
    blamed: tuple[tuple[tuple[str, ...], float], ...] = ()


@dataclasses.dataclass(frozen=True)
class Sensitivity:
    """The result of an analysis: modules with int8 nodes, worst first, and together.

    Attributes:
        findings: modules, worst first.
        together: of all modules.
        trials: number of variants.
        float_driving: driving score of the float model; None if nothing is driven.
        driving: of all modules in int8; likewise.
    """

    findings: tuple[ModuleSensitivity, ...]
    together: Score
    trials: int
    float_driving: float | None = None
    driving: float | None = None


def analyse(
    trials: Trials,
    modules: Sequence[str],
    *,
    node_trials: int = 24,
    progress: Callable[[int, int, str], None] | None = None,
) -> Sensitivity:
    """Score every module alone, then bisect it to the nodes that cost most.

    Half of a module's nodes is int8 at a time, then half of the costly half, and so on:
    a node among n is found in about 2 log2 n trials. Modules are driven if the trials
    have a hook for that; halves of modules are not. At most ``node_trials`` are spent
    on the nodes of one module; ``progress`` is called as ``progress(modules done,
    modules, module)``.
    """
    # every module alone, bisected if it costs anything
    findings = []
    active = [name for name in modules if names_of(trials, name)]
    for done, module in enumerate(active):
        if progress:
            progress(done, len(active), module)
        names = names_of(trials, module)
        score = trials.score(Int8Choice((module,)))
        blamed: tuple[tuple[tuple[str, ...], float], ...] = ()
        if node_trials and score.loss > 0:
            blamed = _blamed(trials, module, names, score.loss, node_trials)
        driving = trials.driving(Int8Choice((module,)))
        findings.append(ModuleSensitivity(module, len(names), score, driving, blamed))
    findings.sort(key=lambda each: -each.score.loss)
    # all modules together, beside the float model
    every = Int8Choice(tuple(active))
    together = trials.score(every)
    return Sensitivity(
        tuple(findings),
        together,
        trials.done,
        float_driving=trials.driving(Int8Choice(())),
        driving=trials.driving(every),
    )


def names_of(trials: Trials, module: str) -> tuple[str, ...]:
    """Name the nodes that are int8 when a module is, in graph order.

    Residual Adds are left out: they follow their convolution.
    """
    chosen = trials.plan(Int8Choice((module,))).chosen
    return tuple(dict.fromkeys(each.node for each in chosen if each.rule != RESIDUAL))


def _blamed(
    trials: Trials, module: str, names: Sequence[str], loss: float, budget: int
) -> tuple[tuple[tuple[str, ...], float], ...]:
    """Find the groups of a module's nodes that cost much alone, the worst first."""
    left = budget

    def alone(half: Sequence[str]) -> tuple[Sequence[str], float]:
        nonlocal left
        left -= 1
        floats = tuple(name for name in names if name not in half)
        return half, trials.score(Int8Choice((module,), floats)).loss

    found = bisect(
        names, loss, lambda halves, _: [*map(alone, halves)], lambda: left >= 2
    )
    kept = [
        (tuple(each.items), each.loss)
        for each in found
        if not each.spread and len(each.items) < len(names)
    ]
    return tuple(sorted(kept, key=lambda each: -each[1]))


@dataclasses.dataclass(frozen=True)
class Group(Generic[Item]):
    """Things that are costly together, and are not split further.

    ``spread`` says that neither half alone costs much of the whole.
    """

    items: Sequence[Item]
    loss: float
    spread: bool


def bisect(
    items: Sequence[Item],
    loss: float,
    measure: Callable[
        [tuple[Sequence[Item], Sequence[Item]], float],
        Sequence[tuple[Sequence[Item], float]],
    ],
    may_go_on: Callable[[], bool],
) -> Iterator[Group[Item]]:
    """Split the costliest group in half, for as long as a half costs much of the whole.

    ``measure`` gets two halves and the loss of both, and returns those that may be
    split in turn, each with its loss; ``may_go_on`` says whether trials are left.
    Yields the groups that stay whole.
    """
    waiting = [(items, loss)]
    while waiting:
        waiting.sort(key=lambda each: -each[1])
        group, cost = waiting.pop(0)
        if len(group) < 2 or not may_go_on():
            yield Group(group, cost, spread=False)
            continue
        middle = len(group) // 2
        halves = measure((group[:middle], group[middle:]), cost)
        costly = [each for each in halves if each[1] >= BLAME * loss]
        if not costly:
            yield Group(group, cost, spread=True)
        waiting += costly
