"""Measure the loss of int8 module by module, and find the nodes to blame."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.fidelity.compare import Fidelity, Reference
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.quantization.plan import RESIDUAL, Overrides, QuantPlan, make_plan
from me2e_compress.quantization.plan.overrides import keep_float, overrides_text
from me2e_compress.quantization.rules import RuleSet
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.registry import drafts
from me2e_compress.registry.documents import toml_string
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session
from me2e_compress.targets import Target

# Judge many int8 variants of one float model that is calibrated once.


@dataclasses.dataclass(frozen=True)
class Int8Choice:
    """The modules that are int8, in map order, and their nodes that stay float."""

    modules: tuple[str, ...]
    floats: tuple[str, ...] = ()

    def overrides(self) -> Overrides:
        """Build the overrides that keep the nodes in float."""
        return Overrides(
            override=tuple(keep_float(name, "sensitive") for name in self.floats)
        )


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
        worst = min(each.sqnr_db for each in self.fidelity.outputs)
        return float(10 ** (-worst / 20))

    @property
    def unit(self) -> str:
        """Unit of the loss."""
        return "m" if self.fidelity.plan is not None else "of the signal"


class Trials:
    """Makes int8 variants of a model and judges them; each choice once.

    ``model`` is the float graph after the exact passes, shapes inferred; fidelity is
    judged on the graph as ``target`` writes it; ``ranges`` cover every tensor that any
    variant needs; ``frames`` are read once for every variant. ``reference`` holds the
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
        self.model = model
        self.modules = modules
        self.done = 0
        self._rules = rules
        self._target = target
        self.ranges = ranges
        self._session = partial(Session, release=True, provider=provider)
        # every choice is judged once
        self._known: dict[Int8Choice, Score] = {}
        self.reference = Reference.of(self._session(model), frames)

    def plan(self, choice: Int8Choice) -> QuantPlan:
        """Decide for every node, as ``quantize-int8`` will for the recipe."""
        scheme = QuantScheme.of(choice.modules, self.modules)
        pins, target = choice.overrides(), self._target
        return make_plan(
            self.model,
            scheme,
            self._rules,
            pins,
            target.costs,
            target.fused_objection,
        )

    def variant(self, choice: Int8Choice) -> ir.Model:
        """Build the graph of a choice."""
        if not choice.modules:
            return self.model
        return self._target.place(self.model, self.plan(choice), self.ranges)

    def score(self, choice: Int8Choice) -> Score:
        """Build, run and judge a choice."""
        if choice not in self._known:
            graph_of_choice = self.variant(choice)
            self._known[choice] = Score(
                self.reference.compare(self._session(graph_of_choice)),
                graph.size(graph_of_choice).weight_bytes,
            )
            self.done += 1
        return self._known[choice]


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


# Choose what stays float, and write the choice as a recipe.


def advise(trials: Trials, found: Sensitivity, limit: float) -> Int8Choice:
    """Choose what keeps the loss within a limit, with as little in float as possible.

    It starts with all modules in int8. Until the measured loss is within the limit, the
    costliest module first gives up the blamed nodes, the worst first, then all of its
    nodes. Then each that was given up, the last first, returns to int8 if the loss
    stays within the limit: errors may cancel, or one costly node hide behind another.
    The choice has no module if nothing keeps the limit.
    """

    def fits(given: Sequence[_Sacrifice]) -> bool:
        choice = _without(trials, found, given)
        return not choice.modules or trials.score(choice).loss <= limit

    # give up nodes and modules until the limit is kept
    order, given = _sacrifices(found), list[_Sacrifice]()
    while not fits(given):
        given.append(order[len(given)])
    # take back what turns out not to matter
    for each in reversed(given):
        kept = [other for other in given if other is not each]
        if each.loss <= limit and fits(kept):
            given = kept
    return _without(trials, found, given)


@dataclasses.dataclass(frozen=True, eq=False)
class _Sacrifice:
    """Nodes of a module, or all of it (None), with their loss as the only int8."""

    module: str
    nodes: tuple[str, ...] | None
    loss: float


def _sacrifices(found: Sensitivity) -> list[_Sacrifice]:
    """List everything in the order in which it is given up."""
    order = []
    for each in found.findings:
        name, own = each.module, each.score.loss
        order += [_Sacrifice(name, (node,), loss) for node, loss in each.blamed]
        order.append(_Sacrifice(name, None, own))
    return order


def _without(
    trials: Trials, found: Sensitivity, given: Sequence[_Sacrifice]
) -> Int8Choice:
    """Return the choice of all modules but what was given up."""
    gone = {each.module for each in given if each.nodes is None}
    names = dict[str, list[str]]()
    for each in given:
        if each.module not in gone:
            names.setdefault(each.module, []).extend(each.nodes or ())
    # A module that gave up each of its nodes is given up.
    gone |= {
        each.module
        for each in found.findings
        if len(set(names.get(each.module, ()))) >= each.nodes
    }
    left = {each.module for each in found.findings} - gone
    floats = [name for module in names if module in left for name in names[module]]
    modules = (name for name in trials.modules.names() if name in left)
    return Int8Choice(tuple(modules), tuple(floats))


def write_recipe(
    path: Path,
    choice: Int8Choice,
    passes: Sequence[str],
    rules: str,
    target: str,
) -> Path | None:
    """Write a recipe and, if nodes stay float, the overrides beside it.

    ``passes`` are the names of those before int8. Returns the file of overrides, None
    if none is needed.
    """
    # the exact passes, then int8
    lines = [f"[[pass]]\nname = {toml_string(name)}\n" for name in passes]
    overrides = path.with_name(path.stem + ".overrides.toml")
    if choice.modules:
        options = [
            "[[pass]]",
            'name = "quantize-int8"',
            f"modules = {_array(choice.modules)}",
            f"rules = {toml_string(rules)}",
            f"target = {toml_string(target)}",
        ]
        if choice.floats:
            options.append(f"overrides = {toml_string(overrides.name)}")
        lines.append("\n".join(options) + "\n")
    # recipe and overrides together, or neither
    with drafts.all_or_none():
        write_bytes(path, (drafts.IN_TOML + "\n".join(lines)).encode())
        if not choice.floats or not choice.modules:
            return None
        text = drafts.IN_TOML + overrides_text(choice.overrides().override)
        write_bytes(overrides, text.encode())
    return overrides


def _array(names: tuple[str, ...]) -> str:
    return f"[{', '.join(toml_string(name) for name in names)}]"
