"""The module of every node of a graph, and the rule that found it."""

import dataclasses
from collections import Counter
from collections.abc import Mapping
from typing import Literal

import onnx_ir as ir

from me2e_compress.graph.modules.module_map import ModuleMap

Rule = Literal["stamp", "parameter", "scope", "neighbour"]


@dataclasses.dataclass(frozen=True)
class Placement:
    """The module of a node, and the rule that found it."""

    module: str
    rule: Rule


@dataclasses.dataclass(frozen=True, repr=False)
class Assignment:
    """The module of every node of a graph and its subgraphs, in graph order."""

    modules: ModuleMap
    placements: Mapping[ir.Node, Placement]

    def module_of(self, node: ir.Node) -> str:
        """Return the module of a node of the graph that was assigned."""
        return self.placements[node].module

    def nodes(self, module: str) -> list[ir.Node]:
        """List a module's nodes in graph order."""
        return [n for n, place in self.placements.items() if place.module == module]

    def rules(self) -> dict[Rule, int]:
        """Count the nodes that each rule decided."""
        return dict(Counter(place.rule for place in self.placements.values()))
