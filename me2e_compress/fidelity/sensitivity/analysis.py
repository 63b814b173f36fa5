"""Measure the loss of int8 module by module, and find the nodes to blame."""

import dataclasses
from collections.abc import Callable, Sequence

from me2e_compress.fidelity.sensitivity.trials import Int8Choice, Score, Trials
from me2e_compress.quantization.plan import RESIDUAL

BLAME = 0.5
"""Nodes are to blame if they alone cost this part of what their module costs."""


@dataclasses.dataclass(frozen=True)
class ModuleSensitivity:
    """The loss of one module when it alone is int8.

    Attributes:
        nodes: int8 nodes then.
        blamed: of the worst module the nodes that are costly alone, with their measured
            losses, worst first; empty if the loss is spread over the module.
    """

    module: str
    nodes: int
    score: Score
    blamed: tuple[tuple[str, float], ...] = ()


@dataclasses.dataclass(frozen=True)
class Sensitivity:
    """The result of an analysis: modules with int8 nodes, worst first, and together.

    Attributes:
        findings: modules, worst first.
        together: of all modules.
        trials: number of variants.
    """

    findings: tuple[ModuleSensitivity, ...]
    together: Score
    trials: int


def analyse(
    trials: Trials,
    modules: Sequence[str],
    *,
    node_trials: int = 16,
    progress: Callable[[int, int, str], None] | None = None,
) -> Sensitivity:
    """Score every module alone, then halves of the worst one's nodes.

    Halving runs at most ``node_trials`` variants; ``progress`` is called as
    ``progress(steps done, steps, module)``.
    """
    active = [name for name in modules if names_of(trials, name)]
    # every module alone
    findings = []
    for done, module in enumerate(active):
        if progress:
            progress(done, len(active) + 1, module)
        score = trials.score(Int8Choice((module,)))
        nodes = len(names_of(trials, module))
        findings.append(ModuleSensitivity(module, nodes, score))
    findings.sort(key=lambda each: -each.score.loss)
    # halves of the worst
    worst = findings[0] if findings else None
    if worst is not None and worst.score.loss > 0 and worst.nodes > 1:
        if progress:
            progress(len(active), len(active) + 1, f"nodes of {worst.module}")
        blamed = _blamed(trials, worst.module, worst.score.loss, node_trials)
        findings[0] = dataclasses.replace(worst, blamed=blamed)
    # all modules together
    together = trials.score(Int8Choice(tuple(active)))
    return Sensitivity(tuple(findings), together, trials.done)


def names_of(trials: Trials, module: str) -> tuple[str, ...]:
    """Name the nodes that are int8 when a module is, in graph order.

    Residual Adds are left out: they follow their convolution.
    """
    chosen = trials.plan(Int8Choice((module,))).chosen
    return tuple(dict.fromkeys(each.node for each in chosen if each.rule != RESIDUAL))


def _blamed(
    trials: Trials, module: str, loss: float, most: int
) -> tuple[tuple[str, float], ...]:
    """Halve a module's nodes until those that cost much stand alone, worst first.

    The costliest part is halved next, each half int8 with the rest of the module in
    float; parts that cost less than `BLAME` of the module are left. Two costly nodes in
    one half are found one by one, nodes that cost little each never. At most ``most``
    variants are run.
    """
    names = names_of(trials, module)
    parts, blamed = [(loss, names)], list[tuple[str, float]]()
    while parts:
        parts.sort(key=lambda each: each[0])
        own, part = parts.pop()
        if len(part) == 1:
            blamed.append((part[0], own))
            continue
        if most < 2:  # no two halves more
            break
        most -= 2
        middle = len(part) // 2
        for half in (part[:middle], part[middle:]):
            rest = tuple(name for name in names if name not in half)
            cost = trials.score(Int8Choice((module,), rest)).loss
            if cost >= BLAME * loss:
                parts.append((cost, half))
    return tuple(sorted(blamed, key=lambda each: -each[1]))
