"""Places of a graph where something wrong is computed of what is right."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import onnx_ir as ir

from me2e_compress.fidelity.correspondence import Held
from me2e_compress.fidelity.sketches import decibels
from me2e_compress.graph.nodes import constant_values, reads_of
from me2e_compress.graph.provenance import module_of, read

JUMP = 10.0
"""A value this much farther off than all that it is computed of is suspected: rounding
grows less in one step where nothing cancels."""


@dataclasses.dataclass(frozen=True)
class Place:
    """Nodes that compute something else than the source does.

    Attributes:
        module: the module of the node that gives the value; empty if not known.
        value: the first value that differs.
        nodes: those between it and values that agree, in order: one of them is wrong.
            Those without a name are called by what they give.
        operators: their operators.
        origins: the nodes of the source that they stand for, where they say so.
        sqnr_db: of the value, dB.
        own_db: its SQNR when only these nodes run, on the source's values; None where
            they do not run alone.
        reaches: whether the error reaches an output.
    """

    module: str
    value: str
    nodes: tuple[str, ...]
    operators: tuple[str, ...]
    origins: tuple[str, ...]
    sqnr_db: float
    own_db: float | None
    reaches: bool

    @property
    def named(self) -> str:
        """The node; of several the last two, and how many more there are."""
        named = [
            f"{name} ({operator})"
            for name, operator in zip(self.nodes, self.operators, strict=True)
        ]
        if len(named) == 1:
            return f"node {named[0]}"
        more = f" and {len(named) - 2} before" if len(named) > 2 else ""
        return f"one of {', '.join(named[-2:])}{more}"


@dataclasses.dataclass(frozen=True)
class Region:
    """A value below the floor and the nodes that compute it of values that are held.

    Attributes:
        value: what is below the floor.
        nodes: from held values, inputs and weights to it.
        reads: those values and inputs.
        jump: how much farther off the value is than the worst of them.
        reaches: whether its error reaches an output.
    """

    value: ir.Value
    nodes: tuple[ir.Node, ...]
    reads: tuple[ir.Value, ...]
    jump: float
    reaches: bool


class Regions:
    """A graph whose values are held against another's.

    Args:
        model: the graph.
        held: its values that were held, with how far they are off.
        tolerance: the gap beyond which a value differs.
    """

    def __init__(
        self, model: ir.Model, held: Mapping[ir.Value, Held], tolerance: float
    ) -> None:
        self.held, self.tolerance = held, tolerance
        self.nodes, self.outputs = list(model.graph), list(model.graph.outputs)
        self.order = {node: at for at, node in enumerate(self.nodes)}
        self.constant = constant_values(model)
        # readers stand for the bodies in them
        self.readers: dict[ir.Value, dict[ir.Node, None]] = {}
        for node in self.nodes:
            for value in reads_of(node):
                self.readers.setdefault(value, {})[node] = None
        self.reaching = self._reaching()

    def suspects(self) -> tuple[list[Region], ...]:
        """List the places that may be wrong: the surest, the next, and the rest.

        The surest are computed of what agrees, and their error goes on. The next are
        farther off by :data:`JUMP` than all that they are computed of. Of the rest
        those come first whose error goes on, and grows most.
        """
        found = [
            self.region(value)
            for node in self.nodes
            for value in node.outputs
            if self.differs(value)
        ]
        sure = [each for each in found if each.reaches and each.jump == math.inf]
        jumping = [each for each in found if each.reaches and each.jump >= JUMP]
        rest = [each for each in found if not each.reaches or each.jump < JUMP]
        rest.sort(key=lambda each: (not each.reaches, -each.jump))
        return sure, [each for each in jumping if each.jump < math.inf], rest

    def differs(self, value: ir.Value) -> bool:
        """Return whether a value was held and is too far off."""
        return value in self.held and self.held[value].gap > self.tolerance

    def region(self, value: ir.Value) -> Region:
        """Walk back from a value to those that were held."""
        nodes: dict[ir.Node, None] = {}
        reads: dict[ir.Value, None] = {}
        waiting = [value.producer()]
        while waiting:
            node = waiting.pop()
            if node is None or node in nodes:
                continue
            nodes[node] = None
            for each in reads_of(node):
                if each in self.held or each.is_graph_input():
                    reads[each] = None
                else:
                    waiting.append(each.producer())
        worst = max(
            (self.held[each].gap for each in reads if self.differs(each)), default=0.0
        )
        gap = self.held[value].gap
        return Region(
            value,
            tuple(sorted(nodes, key=lambda node: self.order[node])),
            tuple(reads),
            math.inf if not worst else gap / worst if worst < math.inf else 1.0,
            value in self.reaching,
        )

    def _reaching(self) -> set[ir.Value]:
        """Find the values whose error reaches an output."""
        found = set[ir.Value]()
        for node in reversed(self.nodes):
            for value in node.outputs:
                led = any(
                    out in found
                    for reader in self.readers.get(value, ())
                    for out in reader.outputs
                )
                wrong = self.differs(value)
                if (wrong and value.is_graph_output()) or (
                    led and (wrong or value not in self.held)
                ):
                    found.add(value)
        return found


def merged(
    regions: Regions, wrong: Sequence[tuple[Region, float | None]]
) -> tuple[Place, ...]:
    """Describe places in the order of the graph; those that share nodes are one."""

    def first(pair: tuple[Region, float | None]) -> int:
        node = pair[0].value.producer()
        return -1 if node is None else regions.order[node]

    groups: list[list[tuple[Region, float | None]]] = []
    for pair in sorted(wrong, key=first):
        mine = _computing(regions, pair[0])
        for group in groups:
            if any(mine & _computing(regions, region) for region, _ in group):
                group.append(pair)
                break
        else:
            groups.append([pair])
    return tuple(_place(regions, group) for group in groups)


def _computing(regions: Regions, region: Region) -> set[ir.Node]:
    """Return the nodes of a region that depend on the inputs."""
    return {
        node
        for node in region.nodes
        if not all(value in regions.constant for value in node.outputs)
    }


def _place(regions: Regions, group: Sequence[tuple[Region, float | None]]) -> Place:
    region, own = group[0]
    nodes = dict.fromkeys(node for each, _ in group for node in each.nodes)
    ordered = sorted(nodes, key=lambda node: regions.order[node])
    pasts = [past for node in ordered if (past := read(node)) is not None]
    maker = region.value.producer()
    return Place(
        "" if maker is None else module_of(maker),
        str(region.value.name),
        tuple(node.name or str(node.outputs[0].name) for node in ordered),
        tuple(node.op_type for node in ordered),
        tuple(dict.fromkeys(name for past in pasts for name in past.origins)),
        decibels(regions.held[region.value].gap),
        None if own is None else decibels(own),
        any(each.reaches for each, _ in group),
    )
