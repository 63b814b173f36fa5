"""Remove whole modules from a graph."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, Literal

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.display import counted
from me2e_compress.errors import PreconditionError, RecipeError
from me2e_compress.graph import provenance, rewrite
from me2e_compress.graph.modules import ModuleMap, Substitute
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, makers_of, reads_of
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.edges import Edge, add_edge
from me2e_compress.passes.parts import Part, within
from me2e_compress.passes.substitutes import (
    constant_like,
    means_of,
    module_of,
    replace_readers,
    result_of,
    shaped_like,
    zeros_like,
)

PLANNER = "planner"
"""The module that makes the plan, in every preset."""

_LAYOUT = LAYOUT_OPERATORS | {"Cast"}
"""Operators that only change the layout or type of another node's result."""


@dataclasses.dataclass(frozen=True)
class AblateModules(Pass):
    """Remove modules and give their readers a substitute, a mean, or zeros.

    Given:   features -> occupancy -> plan

    Result:  features,   zeros     -> plan

    With ``fill="substitute"`` the substitutes of the module map are applied first: the
    result of one scope replaces that of another, repeated where the readers expect more
    queries (without motion, one track query for each of six modes). Every other value
    that leaves a dropped module becomes zeros of its shape or, with ``fill="means"``,
    its mean over the context's frames. A node that only changes the layout of a value
    of a module that stays (a cast that two modules share) moves to its reader. Dead
    nodes are removed, in other modules too.

    With ``edges`` a part of the graph also reads another one directly::

        Given:   map -> motion -> planner
        Result:  map -> motion -> planner, map -> planner

    Edges have no weights and were never trained: they change the plan.

    Attributes:
        drop: the modules to remove.
        fill: ``substitute`` re-wires as the module map says, and zeros the rest;
            ``zeros`` and ``means`` never re-wire.
        keep: scopes of dropped modules that stay, because another module reads them
            (``*.lane_encoder``).
        drop_outputs: True removes the graph outputs that only a dropped module makes;
            False refuses to drop such a module.
        means: an ``.npz`` of means by value name, for ``fill="means"`` without frames.
        edges: what reads what besides, or instead; ``drop=[]`` adds them alone.
    """

    name: ClassVar[str] = "ablate-modules"
    exact: ClassVar[bool] = False
    drop: tuple[str, ...]
    fill: Literal["zeros", "substitute", "means"] = "substitute"
    keep: tuple[str, ...] = ()
    drop_outputs: bool = False
    means: Path | None = None
    edges: tuple[Edge, ...] = ()

    @property
    def needs_frames(self) -> bool:
        """Whether means must be measured."""
        return self.fill == "means" and self.means is None

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Substitute, add edges, fill the rest, and remove dead nodes.

        Raises:
            ModuleMapError: the map has no such module.
            PreconditionError: a module, substitute, mean or edge does not fit the
                graph, or the plan would be lost or no longer depend on the cameras.
            RecipeError: ``means`` without ``fill="means"``, or nothing to do.
            FramesError: means have no source, or it belongs to another graph.
        """
        # Check the options against the graph and the module map
        self._check_options()
        known = [context.modules.module(name) for name in self.drop]
        _require_nodes(model, self.drop)
        for pattern in self.keep:
            result_of(model, Part(pattern))
        before, seeing = graph.node_count(model), _seeing(model, context.modules)
        # Separate the dropped modules from everything that stays
        _hand_over(model, self._goes)
        gone = self._cut_outputs(model)
        notes = [f"output removed: {name}" for name in gone]
        # Rewire readers to substitutes and along new edges
        if self.fill == "substitute":
            for module in known:
                notes += [
                    self._substitute(model, each, context.modules)
                    for each in module.substitutes
                ]
        notes += [
            add_edge(model, edge, context.modules, self._goes, self.name)
            for edge in self.edges
        ]
        # Fill what is left after the first sweep, then sweep again
        rewrite.sweep(model)
        notes += self._fill(model, context)
        rewrite.sweep(model)
        model.graph.sort()
        # The planner must still depend on the cameras
        _check_sight(model, context.modules, seeing, self.drop)
        removed = before - graph.node_count(model)
        said = counted(abs(removed), "node")
        notes.append(f"{said} {'removed' if removed >= 0 else 'added'}")
        return PassResult(model, max(1, removed), tuple(notes), tuple(gone))

    def _check_options(self) -> None:
        if self.means is not None and self.fill != "means":
            raise RecipeError(f"{self.name}: means goes with fill=means only")
        if not self.drop and not self.edges:
            raise RecipeError(f"{self.name}: drop is empty, and there are no edges")

    def _goes(self, node: ir.Node | None) -> bool:
        if node is None or provenance.module_of(node) not in self.drop:
            return False
        return not any(within(node, pattern) for pattern in self.keep)

    def _dropped(self, value: ir.Value) -> bool:
        return self._goes(value.producer())

    def _readers(self, value: ir.Value) -> list[ir.Node]:
        return sorted(value.consumers(), key=self._goes)

    def _fill(self, model: ir.Model, context: Context) -> list[str]:
        where, exits = model.graph, self._exits(model)
        if self.fill == "means":
            means, how = means_of(model, exits, context, self.means)
            for value in exits:
                mean = means[str(value.name)]
                replace_readers(value, constant_like(where, value, mean))
            return [f"{value.name} reads as {how}" for value in exits]
        for value in exits:
            replace_readers(value, self._zeros(where, value))
        return [f"{value.name} reads as zeros" for value in exits]

    def _zeros(self, where: ir.Graph, value: ir.Value) -> ir.Value:
        return zeros_like(where, value, self._readers(value), self.name)

    def _exits(self, model: ir.Model) -> list[ir.Value]:
        return [
            value
            for node in model.graph
            if self._goes(node)
            for value in node.outputs
            if not all(self._goes(reader) for reader in value.consumers())
        ]

    def _cut_outputs(self, model: ir.Model) -> list[str]:
        owned = [value for value in model.graph.outputs if self._dropped(value)]
        names = [str(value.name) for value in owned]
        who, what = ", ".join(self.drop), ", ".join(names)
        if owned and len(owned) == len(model.graph.outputs) and self.drop_outputs:
            raise PreconditionError(f"{who} makes every output: {what}")
        for value in owned:
            if module_of(value) == PLANNER:
                raise PreconditionError(
                    f"{PLANNER} cannot be dropped: it makes {value.name}"
                )
        if owned and not self.drop_outputs:
            raise PreconditionError(
                f"{who} makes the outputs {what}: drop_outputs=true removes them too"
            )
        for value in owned:
            model.graph.outputs.remove(value)
        return names

    def _substitute(
        self, model: ir.Model, wanted: Substitute, modules: ModuleMap
    ) -> str:
        if wanted.reader is not None and wanted.by is not None:
            return self._read_instead(model, wanted, modules)
        # Zeros take the place where the map names no substitute
        old = result_of(model, Part.of(wanted.scope, modules))
        if self._dropped(old):
            return f"{wanted.scope} is dropped itself: nothing is substituted"
        if wanted.by is None:
            replace_readers(old, self._zeros(model.graph, old))
            return f"{wanted.scope} reads as zeros"
        # A substitute must stay in the graph and not read the old result
        new = result_of(model, Part.of(wanted.by, modules), like=old)
        if self._dropped(new):
            raise PreconditionError(
                f"{wanted.by} cannot substitute for {wanted.scope}: it is of module"
                f" {module_of(new)}, which is dropped too"
            )
        makers = makers_of([new])
        if new is old or any(old in reads_of(node) for node in makers):
            raise PreconditionError(
                f"{wanted.by} cannot substitute for {wanted.scope}: it reads its result"
            )
        readers = self._readers(old)
        replace_readers(old, shaped_like(model.graph, new, old, readers, self.name))
        return f"{wanted.scope} replaced by {wanted.by}"

    def _read_instead(
        self, model: ir.Model, wanted: Substitute, modules: ModuleMap
    ) -> str:
        reader = Part.of(str(wanted.reader), modules)
        if not any(reader.holds(node) and not self._goes(node) for node in model.graph):
            return f"{wanted.reader} is not there: nothing is substituted for it"
        edge = Edge(str(wanted.by), reader.name, "replace", of=wanted.scope)
        return add_edge(model, edge, modules, self._goes, self.name)


def _require_nodes(model: ir.Model, drop: tuple[str, ...]) -> None:
    present = sorted({provenance.module_of(node) for node in model.graph} - {""})
    for name in drop:
        if name not in present:
            raise PreconditionError(
                f"no node belongs to module {name}; the graph has {', '.join(present)}"
            )


def _hand_over(model: ir.Model, goes: Callable[[ir.Node], bool]) -> int:
    """Move layout nodes of dropped modules into their readers' modules; count them.

    Exporters write an equal cast of two modules once, with the scope of the first.
    """
    # Find layout nodes whose inputs all come from modules that stay
    carriers = dict[ir.Node, None]()
    for node in model.graph:
        makers = [value.producer() for value in node.inputs if value is not None]
        outside = all(
            maker is None or maker in carriers or not goes(maker) for maker in makers
        )
        if node.op_type in _LAYOUT and goes(node) and outside:
            carriers[node] = None
    # Stamp them with the module of their first remaining reader
    count = 0
    for node in reversed(carriers):
        readers = [reader for reader in node.outputs[0].consumers() if not goes(reader)]
        past = provenance.read(node)
        if readers and past is not None:
            module = provenance.module_of(readers[0])
            provenance.stamp(node, dataclasses.replace(past, module=module))
            count += 1
    return count


def _seeing(model: ir.Model, modules: ModuleMap) -> tuple[str, ...]:
    """Return the planner's outputs that depend on the feature extraction."""
    features = set(modules.names("feature"))
    return tuple(
        str(value.name)
        for value in model.graph.outputs
        if module_of(value) == PLANNER
        and any(provenance.module_of(node) in features for node in makers_of([value]))
    )


def _check_sight(
    model: ir.Model, modules: ModuleMap, before: tuple[str, ...], drop: tuple[str, ...]
) -> None:
    """Raise a PreconditionError unless the plan still depends on the cameras."""
    seeing = _seeing(model, modules)
    blind = [name for name in before if name not in seeing]
    if blind:
        features = ", ".join(modules.names("feature"))
        how = f"without {', '.join(drop)}" if drop else "by these edges"
        raise PreconditionError(
            f"{how} the plan is cut: {blind[0]} depends on nothing of {features} any"
            f" more; keep a module, or add an edge to the {PLANNER}"
        )
