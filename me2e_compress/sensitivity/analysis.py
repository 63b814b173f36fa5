"""Measure the loss of int8 module by module, and find the nodes to blame."""

import dataclasses
import math
from collections.abc import Callable, Sequence

from me2e_compress.quantization.plan import RESIDUAL
from me2e_compress.sensitivity.estimate import NodeCost
from me2e_compress.sensitivity.trials import Int8Choice, Score, Trials

BLAME = 0.5
"""Nodes are to blame if they alone cost this part of what their module costs."""


@dataclasses.dataclass(frozen=True)
class ModuleSensitivity:
    """The loss of one module when it alone is int8.

    Attributes:
        nodes: int8 nodes then.
        driving: driving score; None if nothing is driven.
        blamed: nodes that are costly alone, with their measured losses, worst first;
            empty if the loss is spread over the module.
    """

    module: str
    nodes: int
    score: Score
    driving: float | None = None
    blamed: tuple[tuple[str, float], ...] = ()


@dataclasses.dataclass(frozen=True)
class Sensitivity:
    """The result of an analysis: modules with int8 nodes, worst first, and together.

    Attributes:
        findings: modules, worst first.
        together: of all modules.
        trials: number of variants.
        nodes: what each int8 node costs each output, as estimated, in graph order.
        float_driving: driving score of the float model; None if nothing is driven.
        driving: of all modules in int8; likewise.
    """

    findings: tuple[ModuleSensitivity, ...]
    together: Score
    trials: int
    float_driving: float | None = None
    driving: float | None = None
    nodes: tuple[NodeCost, ...] = ()


def analyse(
    trials: Trials,
    modules: Sequence[str],
    *,
    node_trials: int = 4,
    progress: Callable[[int, int, str], None] | None = None,
) -> Sensitivity:
    """Score every module alone, and those of its nodes that are estimated to cost most.

    Modules are driven if the trials have a hook for that; nodes are not. At most
    ``node_trials`` nodes of a module are scored alone, 0 estimates none either;
    ``progress`` is called as ``progress(modules done, modules, module)``.
    """
    active = [name for name in modules if names_of(trials, name)]
    costs = trials.costs(Int8Choice(tuple(active))) if node_trials and active else ()
    # every module alone, then the nodes that may be to blame
    findings = []
    for done, module in enumerate(active):
        if progress:
            progress(done, len(active), module)
        names = names_of(trials, module)
        score = trials.score(Int8Choice((module,)))
        blamed: tuple[tuple[str, float], ...] = ()
        if score.loss > 0 and len(names) > 1:
            suspects = _suspects(names, costs, score.output)[:node_trials]
            blamed = _blamed(trials, module, names, suspects, score.loss)
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
        nodes=costs,
    )


def names_of(trials: Trials, module: str) -> tuple[str, ...]:
    """Name the nodes that are int8 when a module is, in graph order.

    Residual Adds are left out: they follow their convolution.
    """
    chosen = trials.plan(Int8Choice((module,))).chosen
    return tuple(dict.fromkeys(each.node for each in chosen if each.rule != RESIDUAL))


def _suspects(
    names: Sequence[str], costs: Sequence[NodeCost], output: str
) -> list[str]:
    """List the nodes of a module that may make much of its noise, the worst first.

    Those without an estimate come last.
    """
    told = {each.node: (each.noise or {}).get(output) for each in costs}
    known = {name: noise for name in names if (noise := told.get(name)) is not None}
    whole = math.hypot(*known.values())
    order = sorted(known, key=lambda name: -known[name])
    loud = [name for name in order if known[name] > 0 and known[name] >= BLAME * whole]
    return [*loud, *(name for name in names if name not in known)]


def _blamed(
    trials: Trials,
    module: str,
    names: Sequence[str],
    suspects: Sequence[str],
    loss: float,
) -> tuple[tuple[str, float], ...]:
    """Score suspects alone, and return those that cost much, the worst first."""
    found = {
        name: trials.score(
            Int8Choice((module,), tuple(other for other in names if other != name))
        ).loss
        for name in suspects
    }
    costly = [(name, own) for name, own in found.items() if own >= BLAME * loss]
    return tuple(sorted(costly, key=lambda each: -each[1]))
