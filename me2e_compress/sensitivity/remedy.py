"""Find the nodes or modules that restore quality when kept in float."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from functools import partial
from itertools import islice
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress.fidelity.compare import Fidelity, Reference
from me2e_compress.fidelity.floor import Floor, Shortfall
from me2e_compress.quantization.plan import FLOAT, RESIDUAL, QuantPlan
from me2e_compress.quantization.plan.overrides import (
    Override,
    keep_float,
    overrides_text,
)
from me2e_compress.runtime.session import Session
from me2e_compress.sensitivity.analysis import bisect

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

    Attributes:
        nodes: noisy alone; in the order in which they were found.
        modules: kept whole; the noise is spread over their nodes.
        shortfalls: that are left; empty if these cure everything.
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


Measure: TypeAlias = Callable[[Sequence[Int8Node]], Fidelity]
"""Builds the variant in which some nodes are float, and compares it."""

Build: TypeAlias = Callable[[Sequence[Override]], ir.Model]
"""Builds the int8 graph again, with overrides behind those that it was built with."""


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
    plan: QuantPlan,
    made: ir.Model,
    build: Build,
    reference: Reference,
    floor: Floor,
    *,
    unsteady: Collection[str] = (),
    progress: Callable[[int, int, str], None] = lambda done, most, what: None,
) -> Remedy:
    """Search what must be float in a graph that was made by a plan, on few frames.

    The first frame alone is compared if it shows the loss.
    """

    def compare(model: ir.Model) -> Fidelity:
        provider = reference.session.provider
        return used.compare(Session(model, release=True, provider=provider))

    first = tuple(islice(reference.frames, 1))
    used = Reference(reference.session, first, reference.answers[:1])
    start = compare(made)
    if not floor.shortfalls(start, unsteady):
        used = reference
        start = compare(made)
    search = RemedySearch(
        int8_nodes(plan),
        lambda floats: compare(build([keep_float(each.name, "") for each in floats])),
        floor,
        unsteady,
        progress=progress,
    )
    return search.run(start)


@dataclasses.dataclass
class RemedySearch:
    """A search of the nodes that must be float for every output to be above the floor.

    The noise of the worst output is followed by bisection: half of the nodes is int8 at
    a time, one trial a step; the other half makes what is left of the noise, as a sum
    of squares. A node that alone makes half of the noise's amplitude is kept float; if
    there is no such node, the module from which most of the noise comes is. Then the
    whole is measured again, and the next one is looked for.

    ``nodes`` are the int8 ones in graph order; ``unsteady`` outputs are not judged;
    ``progress`` is called as ``progress(trials done, most trials, words)``; ``done``
    counts trials, ``alone`` and ``modules`` are kept float so far.
    """

    nodes: Sequence[Int8Node]
    measure: Measure
    floor: Floor
    unsteady: Collection[str] = ()
    most_trials: int = MOST_TRIALS
    progress: Callable[[int, int, str], None] = lambda done, most, what: None
    done: int = 0
    alone: list[Int8Node] = dataclasses.field(default_factory=list)
    modules: list[str] = dataclasses.field(default_factory=list)

    def run(self, start: Fidelity) -> Remedy:
        """Follow the worst output until none is below the floor, or trials run out.

        ``start`` is the fidelity with all nodes in int8.
        """
        found = start
        while below := self.floor.shortfalls(found, self.unsteady):
            # A step of the bisection, and the trial that confirms it.
            if not self._has_left(2) or not self._keep(below[0]):
                break
            found = self._try(self._floats())
        nodes = [each for each in self.alone if each.module not in self.modules]
        return Remedy(tuple(nodes), tuple(self.modules), found, below, self.done)

    def _keep(self, worst: Shortfall) -> bool:
        """Keep more nodes float; False if nothing is left that would help."""
        left = [each for each in self.nodes if each not in self._floats()]
        group = self._narrow(left, worst)
        if len(group) == 1:
            self.alone += group
            return True
        modules = Counter(each.module for each in group if each.module)
        inside = {each.module for each in left}
        if not modules or len(inside) == 1:
            return False  # all that is left would be float
        self.modules.append(modules.most_common(1)[0][0])
        return True

    def _narrow(
        self, group: Sequence[Int8Node], worst: Shortfall
    ) -> Sequence[Int8Node]:
        """Narrow a group down for as long as one half makes most of the noise."""

        def louder(
            halves: tuple[Sequence[Int8Node], Sequence[Int8Node]], noise: float
        ) -> list[tuple[Sequence[Int8Node], float]]:
            first, second = halves
            found = self._try([e for e in self.nodes if e not in first])
            one = self.floor.excess(found, worst.output)
            other = max(noise**2 - one**2, 0.0) ** 0.5
            return [(first, one) if one >= other else (second, other)]

        may_go_on = partial(self._has_left, 2)
        return next(bisect(group, worst.excess, louder, may_go_on)).items

    def _has_left(self, trials: int) -> bool:
        return self.done + trials <= self.most_trials

    def _floats(self) -> list[Int8Node]:
        return [
            each
            for each in self.nodes
            if each in self.alone or each.module in self.modules
        ]

    def _try(self, floats: Sequence[Int8Node]) -> Fidelity:
        self.progress(self.done, self.most_trials, "")
        self.done += 1
        return self.measure(floats)
