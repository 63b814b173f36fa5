"""Find the nodes or modules that restore quality when kept in float."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from typing import TypeAlias

from me2e_compress.fidelity.compare import Fidelity
from me2e_compress.fidelity.floor import Floor, Shortfall
from me2e_compress.quantization.plan import FLOAT, RESIDUAL, QuantPlan
from me2e_compress.quantization.plan.overrides import Override
from me2e_compress.sensitivity.analysis import BLAME
from me2e_compress.sensitivity.recipes import overrides_text
from me2e_compress.sensitivity.trials import keep_float

MOST_TRIALS = 12
"""Variants built and run in one search: one node among a thousand, confirmed."""


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

    ``nodes`` alone make much of the noise, in the order in which they were found;
    ``modules`` are kept whole, where the noise is spread over their nodes.
    ``shortfalls`` are empty if these cure everything.
    """

    nodes: tuple[Int8Node, ...]
    modules: tuple[str, ...]
    fidelity: Fidelity
    shortfalls: tuple[Shortfall, ...]
    trials: int

    @property
    def cures(self) -> bool:
        """Whether nothing is below the floor any more."""
        return not self.shortfalls

    def overrides(self) -> str:
        """Return what ``--overrides`` takes; empty if nothing was found."""
        return overrides_text(
            (
                *(keep_float(each.name, "") for each in self.nodes),
                *(Override(dtype=FLOAT, module=each) for each in self.modules),
            )
        )


Measure: TypeAlias = Callable[[Sequence[Int8Node], Sequence[Int8Node]], Fidelity]
"""Builds the variant in which some nodes are float, and compares it; that, and the
group that is being narrowed down: everything else is float. Without group: none is."""


def int8_nodes(plan: QuantPlan) -> tuple[Int8Node, ...]:
    """List the nodes that a plan makes int8, in graph order.

    Residual Adds are left out, since they follow their convolution, and so are nodes
    without a unique name.
    """
    chosen = [each for each in plan.placed if each.rule != RESIDUAL and each.node]
    often = Counter(each.node for each in chosen)
    return tuple(
        Int8Node(each.node, each.op, each.module)
        for each in chosen
        if often[each.node] == 1
    )


def find_remedy(
    nodes: Sequence[Int8Node],
    start: Fidelity,
    measure: Measure,
    floor: Floor,
    *,
    unsteady: Collection[str] = (),
    most_trials: int = MOST_TRIALS,
    progress: Callable[[int, int, str], None] = lambda done, most, what: None,
) -> Remedy:
    """Search the nodes that must be float for every output to be above the floor.

    The noise of the worst output is followed by bisection: half of the nodes is int8 at
    a time, one trial a step; the other half makes what is left of the noise, as a sum
    of squares. A node that alone makes half of the noise's amplitude is kept float; if
    there is no such node, the module from which most of the noise comes is. Then the
    whole is measured again, and the next one is looked for.

    ``nodes`` are the int8 ones in graph order, ``start`` is the fidelity with all of
    them; ``unsteady`` outputs are not judged; ``progress`` is called as
    ``progress(trials done, most trials, words)``.
    """
    search = _Search(nodes, measure, floor, unsteady, most_trials, progress)
    return search.run(start)


class _Search:
    """One search: what is float so far, and how many trials are left."""

    def __init__(
        self,
        nodes: Sequence[Int8Node],
        measure: Measure,
        floor: Floor,
        unsteady: Collection[str],
        most_trials: int,
        progress: Callable[[int, int, str], None],
    ) -> None:
        self._nodes = tuple(nodes)
        self._run = measure
        self._floor = floor
        self._unsteady = unsteady
        self._most = most_trials
        self._progress = progress
        self._done = 0
        self._alone: list[Int8Node] = []
        self._modules: list[str] = []

    def run(self, start: Fidelity) -> Remedy:
        """Follow the worst output until none is below the floor, or trials run out."""
        found = start
        while below := self._floor.shortfalls(found, self._unsteady):
            # A step of the bisection, and the trial that confirms it.
            if self._done + 2 > self._most or not self._keep(below[0]):
                break
            found = self._measure(self._floats(), ())
        nodes = [each for each in self._alone if each.module not in self._modules]
        return Remedy(tuple(nodes), tuple(self._modules), found, below, self._done)

    def _keep(self, worst: Shortfall) -> bool:
        """Keep more nodes float; False if nothing is left that would help."""
        left = [each for each in self._nodes if each not in self._floats()]
        # one node that is to blame
        group = self._bisect(left, worst)
        if len(group) == 1:
            self._alone += group
            return True
        # else the module with most of the costly nodes
        modules = Counter(each.module for each in group if each.module)
        inside = {each.module for each in left}
        if not modules or len(inside) == 1:
            return False  # all that is left would be float
        self._modules.append(modules.most_common(1)[0][0])
        return True

    def _bisect(
        self, group: Sequence[Int8Node], worst: Shortfall
    ) -> Sequence[Int8Node]:
        """Narrow a group down for as long as one half makes most of the noise."""
        whole = noise = worst.excess
        while len(group) > 1 and self._done + 1 < self._most:
            middle = len(group) // 2
            first, second = group[:middle], group[middle:]
            floats = [each for each in self._nodes if each not in first]
            one = self._floor.excess(self._measure(floats, group), worst.output)
            other = max(noise**2 - one**2, 0.0) ** 0.5
            if max(one, other) < BLAME * whole:
                break
            group, noise = (first, one) if one >= other else (second, other)
        return group

    def _floats(self) -> list[Int8Node]:
        return [
            each
            for each in self._nodes
            if each in self._alone or each.module in self._modules
        ]

    def _measure(
        self, floats: Sequence[Int8Node], group: Sequence[Int8Node]
    ) -> Fidelity:
        self._progress(self._done, self._most, "")
        self._done += 1
        return self._run(floats, group)
