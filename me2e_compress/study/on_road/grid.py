"""The schemes of a search on the road: each module float, int8 or removed."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import onnx_ir as ir

from me2e_compress.errors import RecipeError
from me2e_compress.graph.modules import ModuleMap, assign
from me2e_compress.manager import recipe
from me2e_compress.passes import Pass
from me2e_compress.passes.ablate_modules import PLANNER, AblateModules
from me2e_compress.passes.fix_shapes import with_sizes
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.plan_adapter import PlanAdapter

BEFORE_ABLATION = "fold-constants"
"""Ablation comes next: before anything merges nodes of different modules."""


@dataclass(frozen=True)
class GridPoint:
    """One assignment of modules, in the map's order; unnamed ones stay in float."""

    int8: tuple[str, ...] = ()
    ablated: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of its variant, ``int8-backbone+neck_without-map``; or ``exact``."""
        parts = (("int8", self.int8), ("without", self.ablated))
        named = [f"{word}-{'+'.join(modules)}" for word, modules in parts if modules]
        return "_".join(named) or "exact"

    def passes(
        self, rules: str, target: str, dims: Mapping[str, int]
    ) -> tuple[Pass, ...]:
        """Return its passes; a removed module leaves its mean over the frames."""
        chosen = list(with_sizes(recipe.load("exact"), dims))
        if self.ablated:
            at = 1 + [each.name for each in chosen].index(BEFORE_ABLATION)
            gone = AblateModules(self.ablated, fill="means", drop_outputs=True)
            chosen.insert(at, gone)
        if self.int8:
            chosen.append(QuantizeInt8(modules=self.int8, rules=rules, target=target))
        return tuple(chosen)


@dataclass(frozen=True)
class GridModules:
    """The modules of a graph that have nodes, in the order of the map.

    ``needed`` are the prediction modules that make the plan, which cannot be removed.
    """

    features: tuple[str, ...]
    predictions: tuple[str, ...]
    needed: tuple[str, ...] = (PLANNER,)

    @classmethod
    def of(cls, model: ir.Model, modules: ModuleMap) -> Self:
        """Read them off a graph."""
        placed = assign(model, modules)
        present = {placed.module_of(node) for node in model.graph}
        named = [str(value.name) for value in model.graph.outputs]
        adapter = PlanAdapter.of(model.metadata_props, named)
        needed = {PLANNER}
        if adapter is not None:
            maker = model.graph.outputs[named.index(adapter.output)].producer()
            needed |= {placed.module_of(maker)} if maker is not None else set()
        features, predictions = (
            tuple(name for name in modules.names(role) if name in present)
            for role in ("feature", "prediction")
        )
        ours = (*features, *predictions)
        return cls(features, predictions, tuple(n for n in ours if n in needed))

    @property
    def names(self) -> tuple[str, ...]:
        """All modules."""
        return self.features + self.predictions

    @property
    def losable(self) -> tuple[str, ...]:
        """Modules that may be removed: of prediction, and not the planner."""
        return tuple(name for name in self.predictions if name not in self.needed)

    def grid(
        self, groups: str | None, ablate: str | None, most_ablated: int
    ) -> tuple[GridPoint, ...]:
        """List the assignments: int8 or float group by group, times what is removed.

        In ``groups``, ``A+B,C`` lets A and B share a choice, C has its own and others
        stay in float; None takes feature extraction and prediction. In ``ablate``,
        ``A,B`` may be removed; None takes all removable ones, ``none`` takes none.
        """
        if groups is None:
            chosen = [each for each in (self.features, self.predictions) if each]
        else:
            chosen = [tuple(each.split("+")) for each in groups.split(",")]
        self._check("--modules", [name for group in chosen for name in group])
        gone = self.losable if ablate is None else _listed(ablate)
        self._check("--ablate", gone)
        for name in gone:
            if name not in self.losable:
                raise RecipeError(
                    f"--ablate {name}: the stack cannot do without it; it can without"
                    f" {', '.join(self.losable) or 'none'}"
                )
        return tuple(dict.fromkeys(self._points(chosen, gone, most_ablated)))

    def _points(
        self, groups: Sequence[tuple[str, ...]], gone: Sequence[str], most: int
    ) -> Iterator[GridPoint]:
        for count in range(min(most, len(gone)) + 1):
            for ablated in itertools.combinations(gone, count):
                for states in itertools.product((False, True), repeat=len(groups)):
                    pairs = zip(groups, states, strict=True)
                    int8 = {name for group, on in pairs if on for name in group}
                    yield GridPoint(
                        tuple(n for n in self.names if n in int8 - {*ablated}),
                        tuple(n for n in self.names if n in ablated),
                    )

    def _check(self, option: str, named: Sequence[str]) -> None:
        for name in named:
            if name not in self.names:
                raise RecipeError(
                    f"{option} {name}: no such module in the graph; it has"
                    f" {', '.join(self.names)}"
                )
            if list(named).count(name) > 1:
                raise RecipeError(f"{option}: {name} stands there twice")


def _listed(text: str) -> tuple[str, ...]:
    return () if text == "none" else tuple(text.split(","))
