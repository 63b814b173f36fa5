"""Find the nodes or modules that restore quality when kept in float."""

import dataclasses
import math
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
from me2e_compress.sensitivity.suffix import Suffix

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
    plan: QuantPlan,
    made: ir.Model,
    trials: "RemedyTrials",
    floor: Floor,
    *,
    unsteady: Collection[str] = (),
    progress: Callable[[int, int, str], None] = lambda done, most, what: None,
) -> Remedy:
    """Search what must be float in a graph that was made by a plan, on few frames."""
    start = trials.begin(made, floor, unsteady)
    nodes, measure = int8_nodes(plan), trials.measure
    return search_remedy(
        nodes, start, measure, floor, unsteady=unsteady, progress=progress
    )


def search_remedy(
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
            if not self._has_left(2) or not self._keep(below[0]):
                break
            found = self._measure(self._floats(), ())
        nodes = [each for each in self._alone if each.module not in self._modules]
        return Remedy(tuple(nodes), tuple(self._modules), found, below, self._done)

    def _keep(self, worst: Shortfall) -> bool:
        """Keep more nodes float; False if nothing is left that would help."""
        left = [each for each in self._nodes if each not in self._floats()]
        group = self._narrow(left, worst)
        if len(group) == 1:
            self._alone += group
            return True
        modules = Counter(each.module for each in group if each.module)
        inside = {each.module for each in left}
        if not modules or len(inside) == 1:
            return False  # all that is left would be float
        self._modules.append(modules.most_common(1)[0][0])
        return True

    def _narrow(
        self, group: Sequence[Int8Node], worst: Shortfall
    ) -> Sequence[Int8Node]:
        """Narrow a group down for as long as one half makes most of the noise."""

        def louder(
            halves: tuple[Sequence[Int8Node], Sequence[Int8Node]], noise: float
        ) -> list[tuple[Sequence[Int8Node], float]]:
            first, second = halves
            floats = [each for each in self._nodes if each not in first]
            found = self._measure(floats, [*first, *second])
            one = self._floor.excess(found, worst.output)
            other = max(noise**2 - one**2, 0.0) ** 0.5
            return [(first, one) if one >= other else (second, other)]

        may_go_on = partial(self._has_left, 2)
        return next(bisect(group, worst.excess, louder, may_go_on)).items

    def _has_left(self, trials: int) -> bool:
        return self._done + trials <= self._most

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


Build: TypeAlias = Callable[[Sequence[Override]], ir.Model]
"""Builds the int8 graph again, with overrides behind those that it was built with."""


class RemedyTrials:
    """Variants of one quantization, compared with the float graph.

    While a group is narrowed down, everything before it is float and answers as it did:
    where that saves more MACs than it costs, only what is behind the group is run
    again. ``before`` is the float graph whose answers ``reference`` holds.
    """

    def __init__(self, before: ir.Model, build: Build, reference: Reference) -> None:
        self._before = before
        self._build = build
        self._reference = reference
        self._suffix: tuple[Suffix, Reference] | None = None
        self._within: frozenset[str] = frozenset()

    def begin(
        self, made: ir.Model, floor: Floor, unsteady: Collection[str]
    ) -> Fidelity:
        """Compare the int8 graph, on its first frame alone if that shows the loss."""
        whole = self._reference
        first = tuple(islice(whole.frames, 1))
        self._reference = Reference(whole.session, first, whole.answers[:1])
        found = self._compare(made)
        if not floor.shortfalls(found, unsteady):
            self._reference = whole
            found = self._compare(made)
        return found

    def measure(
        self, floats: Sequence[Int8Node], group: Sequence[Int8Node] = ()
    ) -> Fidelity:
        """Build a variant and compare it.

        ``floats`` become float; ``group`` holds every node that is int8 then, or is
        empty.
        """
        made = self._build([keep_float(each.name, "") for each in floats])
        # run only what is behind the group, if that can be cut out of the variant
        found = self._narrowed(group)
        if found is not None:
            suffix, reference = found
            part = suffix.cut(made)
            if part is not None:
                return reference.compare(self._session(part))
        return self._compare(made)

    def _compare(self, model: ir.Model) -> Fidelity:
        return self._reference.compare(self._session(model))

    def _session(self, model: ir.Model) -> Session:
        provider = self._reference.session.provider
        return Session(model, release=True, provider=provider)

    def _narrowed(self, group: Sequence[Int8Node]) -> tuple[Suffix, Reference] | None:
        """Return what is behind a group, if running only that is worth its capture."""
        if not group or len(self._reference.answers) > 1:
            return None  # of several frames the state would be another
        names = frozenset(each.name for each in group)
        known = self._suffix if names <= self._within else None
        whole = 1.0 if known is None else known[0].share
        found = Suffix.behind(self._before, names)
        if found is None or not found.outputs:
            return None
        # Each trial saves the difference; capturing costs a run of the graph.
        if math.log2(len(names)) * (whole - found.share) > 1:
            known = found, found.capture(self._before, self._reference)
            self._suffix, self._within = known, names
        return known
