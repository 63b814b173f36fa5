"""Which modules and nodes int8 hurts, and which assignment fits a budget."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base import atomic
from me2e_compress.base.atomic import write_bytes
from me2e_compress.base.display import format_significant
from me2e_compress.base.documents import toml_string
from me2e_compress.base.errors import EvaluationError
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.fidelity.compare import Fidelity, OutputFidelity, Reference, SetTally
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.quantization.decision import (
    RESIDUAL,
    Overrides,
    QuantPlan,
    QuantScheme,
    keep_float,
    overrides_text,
)
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RuleSet
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session
from me2e_compress.targets import Target

__all__ = [
    "Budget",
    "Candidate",
    "Int8Choice",
    "ModuleSensitivity",
    "Score",
    "Sensitivity",
    "Trials",
    "advise",
    "analyse",
    "search",
    "write_recipe",
]


@dataclasses.dataclass(frozen=True)
class Int8Choice:
    """The modules that are int8, in map order, and their nodes that stay float."""

    modules: tuple[str, ...]
    floats: tuple[str, ...] = ()

    def overrides(self) -> Overrides:
        """Build the overrides that keep the nodes in float."""
        pins = (keep_float(name, "sensitive") for name in self.floats)
        return Overrides(override=tuple(pins))


@dataclasses.dataclass(frozen=True)
class Score:
    """The fidelity of an int8 variant to the float model, and its weights' bytes."""

    fidelity: Fidelity
    weight_bytes: int

    @property
    def loss(self) -> float:
        """Metres that the plan moves, mean over the frames; smaller is better.

        For a model whose plan is not known, the noise amplitude of its worst output,
        relative to the signal: 10^(-SQNR / 20).
        """
        if self.fidelity.plan is not None:
            return self.fidelity.plan.mean_m
        return float(10 ** (-self.worst.sqnr_db / 20))

    @property
    def worst(self) -> OutputFidelity:
        """The noisiest output; whole numbers count where there is nothing else."""
        return min(self.fidelity.outputs, key=lambda o: (o.discrete, o.sqnr_db))

    @property
    def unit(self) -> str:
        """Unit of the loss."""
        return "m" if self.fidelity.plan is not None else "of the signal"


class Trials:
    """Makes int8 variants of a model and scores them, sets by agents; each choice once.

    ``model`` is the float graph after the exact passes, shapes inferred; fidelity is
    that of the graph as ``target`` writes it; ``ranges`` cover every tensor that any
    variant needs; ``frames`` are read once for every variant. ``reference`` has the
    float model's answers, ``done`` counts the variants that were built and run.
    """

    def __init__(
        self,
        model: ir.Model,
        modules: ModuleMap,
        rules: RuleSet,
        target: Target,
        ranges: Ranges,
        frames: Frames,
        *,
        provider: Provider = CPU,
    ) -> None:
        self.model, self.modules, self.ranges, self.done = model, modules, ranges, 0
        self._rules, self._target = rules, target
        self._session = partial(Session, release=True, provider=provider)
        self._known: dict[Int8Choice, Score] = {}
        self.reference = Reference.of(self._session(model), frames)

    def plan(self, choice: Int8Choice) -> QuantPlan:
        """Decide for every node, as ``quantize-int8`` will for the recipe."""
        scheme = QuantScheme.of(choice.modules, self.modules)
        pins, target = choice.overrides(), self._target
        return make_plan(
            self.model, scheme, self._rules, pins, target.costs, target.fused_objection
        )

    def variant(self, choice: Int8Choice) -> ir.Model:
        """Return the graph of a choice; with no module, the float model itself."""
        if not choice.modules:
            return self.model
        return self._target.place(self.model, self.plan(choice), self.ranges)

    def score(self, choice: Int8Choice) -> Score:
        """Build a choice, run it and compare it with the float model, once."""
        if choice not in self._known:
            variant = self.variant(choice)
            session, float_session = self._session(variant), self.reference.session
            sets = SetTally.of(float_session, session)
            watching = () if sets is None else (sets.add,)
            fidelity = self.reference.compare(session, watching)
            # Agents in another order are no noise: those that match are compared
            matched = {} if sets is None else sets.result().sqnr_db
            outputs = tuple(
                dataclasses.replace(o, sqnr_db=matched.get(o.name, o.sqnr_db))
                for o in fidelity.outputs
            )
            fidelity = dataclasses.replace(fidelity, outputs=outputs)
            self._known[choice] = Score(fidelity, graph.size(variant).weight_bytes)
            self.done += 1
        return self._known[choice]


BLAME_SHARE = 0.5  # least share of its module's loss that a node to blame has alone


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
    active = [name for name in modules if int8_names(trials, name)]
    # Every module alone
    findings = []
    for done, module in enumerate(active):
        if progress:
            progress(done, len(active) + 1, module)
        score = trials.score(Int8Choice((module,)))
        nodes = len(int8_names(trials, module))
        findings.append(ModuleSensitivity(module, nodes, score))
    findings.sort(key=lambda finding: -finding.score.loss)
    # Halves of the worst
    worst = findings[0] if findings else None
    if worst is not None and worst.score.loss > 0 and worst.nodes > 1:
        if progress:
            progress(len(active), len(active) + 1, f"nodes of {worst.module}")
        blamed = _costly_nodes(trials, worst.module, worst.score.loss, node_trials)
        findings[0] = dataclasses.replace(worst, blamed=blamed)
    # All modules together
    together = trials.score(Int8Choice(tuple(active)))
    return Sensitivity(tuple(findings), together, trials.done)


def int8_names(trials: Trials, module: str) -> tuple[str, ...]:
    """Name the nodes that become int8 if a module does, in graph order."""
    # Residual Adds are left out: they follow their convolution
    chosen = trials.plan(Int8Choice((module,))).chosen
    return tuple(dict.fromkeys(d.node for d in chosen if d.rule != RESIDUAL))


def _costly_nodes(
    trials: Trials, module: str, loss: float, most: int
) -> tuple[tuple[str, float], ...]:
    """Halve a module's nodes until those that cost much stand alone, worst first."""
    # The costliest part is halved next, either half int8 with the rest of the module in
    # float; parts that cost less than `BLAME_SHARE` of the module are left. Two costly
    # nodes in one half are found one by one, nodes that cost little never. At most
    # `most` variants are run.
    names = int8_names(trials, module)
    parts, blamed = [(loss, names)], list[tuple[str, float]]()
    while parts:
        parts.sort(key=lambda part: part[0])  # the costliest last
        own, part = parts.pop()
        if len(part) == 1:
            blamed.append((part[0], own))
            continue
        if most < 2:  # too few trials for two halves
            break
        most -= 2
        middle = len(part) // 2
        for half in (part[:middle], part[middle:]):
            rest = tuple(name for name in names if name not in half)
            cost = trials.score(Int8Choice((module,), rest)).loss
            if cost >= BLAME_SHARE * loss:
                parts.append((cost, half))
    return tuple(sorted(blamed, key=lambda pair: -pair[1]))


# Choose what stays float, and write the choice as a recipe.


def advise(trials: Trials, sensitivity: Sensitivity, limit: float) -> Int8Choice:
    """Choose what keeps the loss within a limit, with as little in float as possible.

    It starts with all modules in int8. Until the measured loss is within the limit, the
    costliest module first gives up the blamed nodes, the worst first, then all of its
    nodes. Then those, the last first, return to int8 if the loss stays within the
    limit: errors may cancel, or one costly node hide another. The choice has no module
    if nothing keeps the limit.
    """

    def fits(sacrifices: Sequence[_Sacrifice]) -> bool:
        choice = _choice_without(trials, sensitivity, sacrifices)
        return not choice.modules or trials.score(choice).loss <= limit

    # Give up nodes and modules until the loss is within the limit
    order, sacrifices = list[_Sacrifice](), list[_Sacrifice]()
    for finding in sensitivity.findings:
        name, own = finding.module, finding.score.loss
        order += [_Sacrifice(name, (node,), loss) for node, loss in finding.blamed]
        order.append(_Sacrifice(name, None, own))
    while not fits(sacrifices):
        sacrifices.append(order[len(sacrifices)])
    # Take back what turns out not to matter
    for last in reversed(sacrifices):
        rest = [other for other in sacrifices if other is not last]
        if last.loss <= limit and fits(rest):
            sacrifices = rest
    return _choice_without(trials, sensitivity, sacrifices)


@dataclasses.dataclass(frozen=True, eq=False)
class _Sacrifice:
    """Nodes of a module, or all of it (None), with their loss as the only int8."""

    module: str
    nodes: tuple[str, ...] | None
    loss: float


def _choice_without(
    trials: Trials, sensitivity: Sensitivity, sacrifices: Sequence[_Sacrifice]
) -> Int8Choice:
    """Return the choice of all modules but what was given up."""
    dropped = {s.module for s in sacrifices if s.nodes is None}
    names = dict[str, list[str]]()
    for sacrifice in sacrifices:
        if sacrifice.module not in dropped:
            names.setdefault(sacrifice.module, []).extend(sacrifice.nodes or ())
    # A module that gave up each of its nodes is given up
    nodes = {finding.module: finding.nodes for finding in sensitivity.findings}
    dropped |= {m for m in nodes if len(set(names.get(m, ()))) >= nodes[m]}
    chosen = nodes.keys() - dropped
    floats = [name for module in names if module in chosen for name in names[module]]
    modules = (name for name in trials.modules.names() if name in chosen)
    return Int8Choice(tuple(modules), tuple(floats))


def write_recipe(
    path: Path, choice: Int8Choice, passes: Sequence[str], rules: str, target: str
) -> Path | None:
    """Write a recipe and, if nodes stay float, the overrides beside it.

    ``passes`` are the names of those before int8. Returns the file of overrides, None
    if none is needed.
    """
    # The exact passes, then int8
    lines = [f"[[pass]]\nname = {toml_string(name)}\n" for name in passes]
    overrides = path.with_name(path.stem + ".overrides.toml")
    if choice.modules:
        options = [
            "[[pass]]",
            'name = "quantize-int8"',
            f"scheme = [{', '.join(map(toml_string, choice.modules))}]",
            f"rules = {toml_string(rules)}",
            f"target = {toml_string(target)}",
        ]
        if choice.floats:
            options.append(f"overrides = {toml_string(overrides.name)}")
        lines.append("\n".join(options) + "\n")
    # Recipe and overrides together, or neither
    with atomic.all_or_none():
        write_bytes(path, (atomic.IN_TOML + "\n".join(lines)).encode())
        if not choice.floats or not choice.modules:
            return None
        text = atomic.IN_TOML + overrides_text(choice.overrides().override)
        write_bytes(overrides, text.encode())
    return overrides


# Choose the modules to make int8 under budgets of time, size and energy.


# All 2^16 assignments are weighed; a map of more modules must be coarser
MOST_MODULES = 16


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

    def costs_of(variant: ir.Model) -> tuple[float, ...]:
        return tuple(budget.cost(variant) for budget in budgets)

    active = [name for name in modules if int8_names(trials, name)]
    if len(active) > MOST_MODULES:
        raise EvaluationError(
            f"{len(active)} modules are more than {MOST_MODULES}: use a coarser map"
        )
    # 1. Every module alone: what it loses, what it saves
    float_costs = costs_of(trials.model)
    losses, savings = dict[str, float](), dict[str, tuple[float, ...]]()
    for done, name in enumerate(active):
        if progress:
            progress(done, len(active), name)
        losses[name] = trials.score(Int8Choice((name,))).loss
        alone = costs_of(trials.variant(Int8Choice((name,))))
        savings[name] = tuple(a - b for a, b in zip(float_costs, alone, strict=True))
    # 2. Every assignment, predicted from that: losses add as independent errors,
    # savings add up; the least loss first, then the cheapest
    ranked = [
        Candidate(
            subset,
            math.sqrt(sum(losses[name] ** 2 for name in subset)),
            tuple(
                cost - sum(savings[name][at] for name in subset)
                for at, cost in enumerate(float_costs)
            ),
        )
        for size in range(len(active) + 1)
        for subset in itertools.combinations(active, size)
    ]
    ranked.sort(key=lambda c: (c.loss, c.costs, c.modules))
    # 3. The best that should fit, and the cheapest, measured until one does
    fitting = [c for c in ranked if _largest_share(budgets, c.costs) <= 1]
    cheapest = min(ranked, key=lambda c: _largest_share(budgets, c.costs))
    tried: list[Candidate] = []
    for candidate in dict.fromkeys((*fitting[: most_tried - 1], cheapest)):
        if not fitting:
            break
        choice = Int8Choice(candidate.modules)
        costs = costs_of(trials.variant(choice))
        score = trials.score(choice)
        tried.append(dataclasses.replace(candidate, score=score, measured_costs=costs))
        if _largest_share(budgets, costs) <= 1:
            return tuple(tried)
    least = [c.costs for c in ranked]
    least += [c.measured_costs for c in tried if c.measured_costs]
    raise EvaluationError(budget_message(budgets, float_costs, least))


def budget_message(
    budgets: Sequence[Budget], whole: Sequence[float], costs: Sequence[Sequence[float]]
) -> str:
    """Return the message that nothing is within the budgets, with the least costs."""

    def amounts(numbers: Iterable[float]) -> str:
        pairs = zip(numbers, budgets, strict=True)
        return " and ".join(f"{format_significant(n, 6)} {b.unit}" for n, b in pairs)

    ending = "; each alone" if len(budgets) > 1 else ""
    return (
        f"nothing fits {amounts(b.limit for b in budgets)}: the float model costs"
        f" {amounts(whole)}, the least found is about"
        f" {amounts(map(min, zip(*costs, strict=True)))}{ending}"
    )


def _largest_share(budgets: Sequence[Budget], costs: Sequence[float]) -> float:
    """Return the largest share of a budget that is spent; above 1 it does not fit."""
    return max(cost / budget.limit for cost, budget in zip(costs, budgets, strict=True))
