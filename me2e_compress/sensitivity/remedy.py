"""Find the nodes or modules that restore quality when kept in float."""

import dataclasses
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TypeAlias, TypeVar

from me2e_compress.fidelity.compare import Fidelity
from me2e_compress.fidelity.floor import Floor, Shortfall
from me2e_compress.quantization.plan import FLOAT
from me2e_compress.quantization.plan.overrides import (
    Override,
    keep_float,
    overrides_text,
)
from me2e_compress.sensitivity.estimate import NodeCost

Key = TypeVar("Key")

MOST_TRIALS = 3
"""Variants built and run in one search: the estimate mostly needs one."""

MOST_NODES = 8
"""Nodes that are named one by one; where it takes more, their modules are."""

MOST_FLOAT = 0.5
"""Part of the int8 nodes that may be kept float: more is no remedy of int8."""

MARGIN = 0.9
"""What is aimed at, of the noise that the floor allows: an estimate is not exact."""


@dataclasses.dataclass(frozen=True)
class Int8Node:
    """A node that is int8, named so that an override can name it.

    ``module`` is its ME2E module, empty if unknown.
    """

    name: str
    op: str
    module: str

    def __str__(self) -> str:
        where = f", module {self.module}" if self.module else ""
        return f"{self.name} ({self.op}{where})"


@dataclasses.dataclass(frozen=True)
class Remedy:
    """What is kept in float to stay true to the float model, and the fidelity then.

    Attributes:
        nodes: those that explain the noise; in the order in which they were found.
        modules: kept whole; the noise is spread over their nodes.
        shortfalls: that are left; empty if these cure everything.
        trials: variants that were built and run.
    """

    nodes: tuple[Int8Node, ...]
    modules: tuple[str, ...]
    fidelity: Fidelity
    shortfalls: tuple[Shortfall, ...]
    trials: int

    def overrides(self) -> str:
        """Return what ``--overrides`` takes; empty if nothing was found."""
        return overrides_text(overrides_of(self.nodes, self.modules))


def overrides_of(
    nodes: Iterable[Int8Node], modules: Iterable[str]
) -> tuple[Override, ...]:
    """Return the overrides that keep nodes and whole modules in float."""
    return (
        *(keep_float(each.name, "") for each in nodes),
        *(Override(dtype=FLOAT, module=each) for each in modules),
    )


Measure: TypeAlias = Callable[[Sequence[Override]], Fidelity]
"""Builds the int8 graph again with these overrides too, and compares it."""


@dataclasses.dataclass
class RemedySearch:
    """A search of the nodes that must be float for every output to be above the floor.

    Noise adds up as squares. The nodes that are estimated to make most of the noise of
    an output are kept float until what is left would be allowed; where that takes too
    many, modules are. A variant is built, and what it shows is the start of the next.

    ``costs`` are of all int8 nodes, for the outputs that are ``told``; what they do not
    explain of the measured noise is shared by the nodes without an estimate.
    ``unsteady`` outputs are not judged.
    """

    costs: Sequence[NodeCost]
    told: Collection[str]
    measure: Measure
    floor: Floor
    unsteady: Collection[str] = ()
    progress: Callable[[int, int, str], None] = lambda done, most, what: None
    nodes: dict[Int8Node, None] = dataclasses.field(default_factory=dict)
    modules: dict[str, None] = dataclasses.field(default_factory=dict)

    def run(self, start: Fidelity) -> Remedy:
        """Keep nodes float until no output is below the floor, or nothing helps.

        ``start`` is the fidelity with all nodes in int8.
        """
        found, done = start, 0
        while below := self.floor.shortfalls(found, self.unsteady):
            if done == MOST_TRIALS or not self._keep(found, below):
                break
            self.progress(done, MOST_TRIALS, "")
            found, done = self.measure(overrides_of(self.nodes, self.modules)), done + 1
        nodes = tuple(each for each in self.nodes if each.module not in self.modules)
        return Remedy(nodes, tuple(self.modules), found, below, done)

    def _keep(self, found: Fidelity, below: Sequence[Shortfall]) -> bool:
        """Keep more nodes float for each output; False if none can help."""
        left = [each for each in self.costs if not self._is_float(each)]
        before = len(self.nodes) + len(self.modules)
        for each in below:
            if each.output not in self.told:
                continue
            power = _powers(left, found, each.output)
            goal = sum(power.values()) * (1 - (MARGIN / each.excess) ** 2)
            named = {cost: own for cost, own in power.items() if self._is_named(cost)}
            nodes = _heaviest(named, goal)
            if nodes is not None and len(nodes) <= MOST_NODES:
                made = (Int8Node(e.node, e.op, e.module) for e in nodes)
                self._add(dict.fromkeys(made), {})
                continue
            # spread over many nodes: whole modules
            inside = dict.fromkeys((cost.module for cost in left if cost.module), 0.0)
            for cost, own in power.items():
                if cost.module:
                    inside[cost.module] += own
            self._add({}, dict.fromkeys(_heaviest(inside, goal) or ()))
        return len(self.nodes) + len(self.modules) > before

    def _add(self, nodes: dict[Int8Node, None], modules: dict[str, None]) -> None:
        """Keep these float too, unless most of the graph would be float then."""
        before = self.nodes, self.modules
        self.nodes, self.modules = self.nodes | nodes, self.modules | modules
        if sum(map(self._is_float, self.costs)) > MOST_FLOAT * len(self.costs):
            self.nodes, self.modules = before

    def _is_float(self, cost: NodeCost) -> bool:
        node = Int8Node(cost.node, cost.op, cost.module)
        return node in self.nodes or cost.module in self.modules

    def _is_named(self, cost: NodeCost) -> bool:
        """Return whether an override can name this node and no other."""
        return [each.node for each in self.costs].count(cost.node) == 1


def _powers(
    costs: Sequence[NodeCost], found: Fidelity, output: str
) -> dict[NodeCost, float]:
    """Return the noise power of each node at an output, relative to its signal.

    Nodes without an estimate share what the others leave of the measured power.
    """
    known = {
        cost: cost.noise[output] ** 2
        for cost in costs
        if cost.noise is not None and output in cost.noise
    }
    unknown = [cost for cost in costs if cost not in known]
    (sqnr,) = (each.sqnr_db for each in found.outputs if each.name == output)
    rest = max(10 ** (-sqnr / 10) - sum(known.values()), 0.0)
    return known | dict.fromkeys(unknown, rest / max(len(unknown), 1))


def _heaviest(power: Mapping[Key, float], goal: float) -> list[Key] | None:
    """Return the fewest keys whose power adds up to a goal; None if all do not."""
    chosen, total = list[Key](), 0.0
    for key in sorted(power, key=lambda each: -power[each]):
        if total >= goal:
            break
        chosen.append(key)
        total += power[key]
    return chosen if total >= goal else None
