"""Measure the loss of int8 module by module, and find the nodes to blame."""

import dataclasses
from collections.abc import Callable, Sequence

from me2e_compress.quantization.plan import RESIDUAL
from me2e_compress.sensitivity.trials import Int8Choice, Score, Trials

BLAME = 0.5
"""Nodes are to blame if they alone cost this part of what their module costs."""


@dataclasses.dataclass(frozen=True)
class ModuleSensitivity:
    """The loss of one module when it alone is int8.

    ``nodes`` counts those that are int8 then; ``driving`` is None if nothing is driven.
    ``blamed`` holds groups of nodes, worst first, each with its loss as the only int8
    nodes of the graph. A single node was found by bisection; a larger group is costly
    only together, or was left whole when the trials were used up. It is empty if the
    loss is spread over the module.
    """

    module: str
    nodes: int
    score: Score
    driving: float | None = None
    blamed: tuple[tuple[tuple[str, ...], float], ...] = ()


@dataclasses.dataclass(frozen=True)
class Sensitivity:
    """The result of an analysis: modules with int8 nodes, worst first, and together.

    ``float_driving`` and ``driving`` are the closed-loop scores of the float model and
    of all modules in int8, None if nothing is driven; ``trials`` counts variants.
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
            blamed = _Bisection(trials, module, names, node_trials).run(score.loss)
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


class _Bisection:
    """The search for the costly nodes of one module."""

    def __init__(
        self, trials: Trials, module: str, names: tuple[str, ...], budget: int
    ) -> None:
        self._trials = trials
        self._module = module
        self._names = names
        self._left = budget

    def run(self, loss: float) -> tuple[tuple[tuple[str, ...], float], ...]:
        """Split the costly groups, the costliest first."""
        open_groups = [(self._names, loss)]
        blamed = []
        while open_groups:
            open_groups.sort(key=lambda each: -each[1])
            group, cost = open_groups.pop(0)
            if len(group) == 1 or self._left < 2:
                blamed.append((group, cost))
                continue
            # keep the halves that alone make much of the loss
            middle = len(group) // 2
            halves = [
                (half, self._loss(half)) for half in (group[:middle], group[middle:])
            ]
            costly = [each for each in halves if each[1] >= BLAME * loss]
            open_groups += costly
        # the whole module is no finding
        found = [each for each in blamed if len(each[0]) < len(self._names)]
        return tuple(sorted(found, key=lambda each: -each[1]))

    def _loss(self, only: tuple[str, ...]) -> float:
        self._left -= 1
        floats = tuple(name for name in self._names if name not in only)
        return self._trials.score(Int8Choice((self._module,), floats)).loss
