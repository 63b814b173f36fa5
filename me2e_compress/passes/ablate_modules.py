"""Remove whole modules from a graph."""

import dataclasses
from collections.abc import Callable
from typing import Literal

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import plural
from me2e_compress.base.errors import PreconditionError, RecipeError
from me2e_compress.graph import provenance, rewrite
from me2e_compress.graph.modules.module_map import ModuleMap, Substitute
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, makers_of, reads_of
from me2e_compress.operators import FusedCall
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.parts import (
    Edge,
    Part,
    add_edge,
    means_of,
    module_of,
    replace_readers,
    result_of,
    shaped_like,
    within,
    writer_for,
    zeros_like,
)

# The module that makes the plan, in every preset.
PLANNER = "planner"

# Operators that only change the layout or type of another node's result.
_LAYOUT = LAYOUT_OPERATORS | {"Cast"}


@dataclasses.dataclass(frozen=True)
class AblateModules(Pass):
    """Remove modules and give their readers a substitute, a mean, or zeros.

    Given:   features -> occupancy -> plan

    Result:  features,   zeros     -> plan

    With ``fill="substitute"`` the substitutes of the module map are applied first: the
    result of one scope replaces that of another, repeated where the readers expect more
    queries (without motion, one track query for each of six modes). Every other value
    that leaves a dropped module becomes zeros of its shape or, with ``fill="means"``,
    its mean over the context's frames. A node of a dropped module that only changes the
    layout of a value from another module (a cast that two modules share) moves to the
    module of its reader. Dead nodes are removed, in other modules too.

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
        edges: what reads what besides, or instead; ``drop=[]`` adds them alone.
    """

    name = "ablate-modules"
    exact = False
    drop: tuple[str, ...]
    fill: Literal["zeros", "substitute", "means"] = "substitute"
    keep: tuple[str, ...] = ()
    drop_outputs: bool = False
    edges: tuple[Edge, ...] = ()

    @property
    def needs_frames(self) -> bool:
        """Whether means must be measured."""
        return self.fill == "means"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Substitute, add edges, fill the rest, and remove dead nodes.

        Raises:
            ModuleMapError: the map has no such module.
            PreconditionError: a module, substitute, mean or edge does not fit the
                graph, or the plan would be lost or no longer depend on the cameras.
            RecipeError: nothing to do.
            FramesError: means have no frames, or they belong to another graph.
        """
        # Check the options against the graph and the module map
        if not self.drop and not self.edges:
            raise RecipeError(f"{self.name}: drop is empty, and there are no edges")
        known = [context.modules.module(name) for name in self.drop]
        present = sorted({provenance.module_of(node) for node in model.graph} - {""})
        if lacking := [name for name in self.drop if name not in present]:
            there = ", ".join(present)
            raise PreconditionError(
                f"no node belongs to module {lacking[0]}; the graph has {there}"
            )
        for pattern in self.keep:
            result_of(model, Part(pattern))
        if self.keep and not any(map(self._is_dropped, model.graph)):
            raise PreconditionError(
                f"{self.name}: keep={list(self.keep)} keeps all of"
                f" {', '.join(self.drop)}: nothing is left to remove"
            )
        before, seeing = (
            graph.node_count(model),
            _seeing_outputs(model, context.modules),
        )
        # Separate the dropped modules from everything that stays
        _move_layout_nodes(model, self._is_dropped)
        gone = self._cut_outputs(model)
        notes = [f"output removed: {name}" for name in gone]
        # Rewire readers to substitutes and along new edges
        modules = context.modules
        if self.fill == "substitute":
            wanted = [one for module in known for one in module.substitutes]
            notes += [self._rewire(model, one, modules) for one in wanted]
        for edge in self.edges:
            notes.append(add_edge(model, edge, modules, self._is_dropped, self.name))
        # Fill what is left after the first sweep, then sweep again
        rewrite.sweep(model)
        notes += self._fill(model, context)
        rewrite.sweep(model)
        model.graph.sort()
        # The planner must still depend on the cameras
        self._check_sight(model, modules, seeing)
        removed = before - graph.node_count(model)
        verb = "removed" if removed >= 0 else "added"
        notes.append(f"{plural(abs(removed), 'node')} {verb}")
        return PassResult(model, max(1, removed), tuple(notes), tuple(gone))

    def _check_sight(
        self, model: ir.Model, modules: ModuleMap, before: tuple[str, ...]
    ) -> None:
        still = _seeing_outputs(model, modules)
        if blind := [name for name in before if name not in still]:
            features = ", ".join(modules.names("feature"))
            how = f"without {', '.join(self.drop)}" if self.drop else "by these edges"
            raise PreconditionError(
                f"{how} the plan is cut: {blind[0]} depends on nothing of {features}"
                f" any more; keep a module, or add an edge to the {PLANNER}"
            )

    def _is_dropped(self, node: ir.Node | None) -> bool:
        if node is None or provenance.module_of(node) not in self.drop:
            return False
        return not any(within(node, pattern) for pattern in self.keep)

    def _fill(self, model: ir.Model, context: Context) -> list[str]:
        # Values of dropped modules that nodes which stay read
        exits = [
            value
            for node in model.graph
            if self._is_dropped(node)
            for value in node.outputs
            if not all(map(self._is_dropped, value.consumers()))
        ]
        if self.fill != "means":
            for value in exits:
                replace_readers(value, zeros_like(self._writer(model, value), value))
            return [f"{value.name} reads as zeros" for value in exits]
        # Means come from the frames, value by value
        means, how = means_of(model, exits, context)
        for value in exits:
            array, name = means[str(value.name)], f"{value.name}_mean"
            replace_readers(value, rewrite.add_constant(model.graph, array, name))
        return [f"{value.name} reads as {how}" for value in exits]

    def _writer(self, model: ir.Model, value: ir.Value) -> FusedCall:
        """Return a writer of nodes for the readers of a value."""
        readers = sorted(value.consumers(), key=self._is_dropped)
        return writer_for(model, readers, self.name)

    def _cut_outputs(self, model: ir.Model) -> list[str]:
        outputs = model.graph.outputs
        owned = [value for value in outputs if self._is_dropped(value.producer())]
        names = [str(value.name) for value in owned]
        who, what = ", ".join(self.drop), ", ".join(names)
        # A graph keeps at least one output, and the plan
        if owned and len(owned) == len(outputs) and self.drop_outputs:
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
            outputs.remove(value)
        return names

    def _rewire(self, model: ir.Model, wanted: Substitute, modules: ModuleMap) -> str:
        if wanted.reader is not None and wanted.by is not None:
            reader = Part.of(wanted.reader, modules)
            if all(self._is_dropped(n) for n in model.graph if reader.holds(n)):
                return f"{wanted.reader} is not there: nothing is substituted for it"
            edge = Edge(wanted.by, reader.name, "replace", of=wanted.scope)
            return add_edge(model, edge, modules, self._is_dropped, self.name)
        # Zeros take the place where the map names no substitute
        old = result_of(model, Part.of(wanted.scope, modules))
        if self._is_dropped(old.producer()):
            return f"{wanted.scope} is dropped itself: nothing is substituted"
        if wanted.by is None:
            replace_readers(old, zeros_like(self._writer(model, old), old))
            return f"{wanted.scope} reads as zeros"
        # A substitute must stay in the graph and not read the old result
        new = result_of(model, Part.of(wanted.by, modules), like=old)
        if self._is_dropped(new.producer()):
            raise PreconditionError(
                f"{wanted.by} cannot substitute for {wanted.scope}: it is of module"
                f" {module_of(new)}, which is dropped too"
            )
        makers = makers_of([new])
        if new is old or any(old in reads_of(node) for node in makers):
            raise PreconditionError(
                f"{wanted.by} cannot substitute for {wanted.scope}: it reads its result"
            )
        replace_readers(old, shaped_like(self._writer(model, old), new, old))
        return f"{wanted.scope} replaced by {wanted.by}"


def _move_layout_nodes(model: ir.Model, is_dropped: Callable[[ir.Node], bool]) -> None:
    """Move layout nodes of dropped modules into their readers' modules.

    Exporters write an equal cast of two modules once, with the scope of the first.
    """
    # Find layout nodes whose inputs all come from modules that stay
    carriers = dict[ir.Node, None]()
    for node in model.graph:
        others = [maker for maker in node.predecessors() if maker not in carriers]
        outside = not any(map(is_dropped, others))
        if node.op_type in _LAYOUT and is_dropped(node) and outside:
            carriers[node] = None
    # Stamp them with the module of their first remaining reader
    for node in reversed(carriers):
        readers = [one for one in node.outputs[0].consumers() if not is_dropped(one)]
        past = provenance.read(node)
        if readers and past is not None:
            module = provenance.module_of(readers[0])
            provenance.stamp(node, dataclasses.replace(past, module=module))


def _seeing_outputs(model: ir.Model, modules: ModuleMap) -> tuple[str, ...]:
    """Return the planner's outputs that depend on the feature extraction."""
    features = set(modules.names("feature"))
    return tuple(
        str(value.name)
        for value in model.graph.outputs
        if module_of(value) == PLANNER
        and any(provenance.module_of(node) in features for node in makers_of([value]))
    )
