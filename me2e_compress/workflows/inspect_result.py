"""The result of an inspection, as it is shown."""

import dataclasses

from me2e_compress.graph import Port
from me2e_compress.graph.modules import Item
from me2e_compress.workflows.result import Result, Table, giga, megabytes, number, table

_SHOWN = 8
"""Number of reasons for unknown MACs that are named."""


@dataclasses.dataclass(frozen=True, repr=False)
class InspectResult(Result):
    """What a file holds.

    Attributes:
        file_bytes: size with the external weights.
        opset: opset of the default domain; `domains` names the others.
        map: the module map that was used.
        rules: nodes placed, by rule of the map.
        macs: multiply-accumulates, those known; None if none is.
        uncounted: nodes that ``macs`` leaves out, by reason.
        open_dimensions: of the inputs; MACs depend on them.
        lowered: what was changed for onnxruntime; empty if nothing.
        hint: what the graph lacks; empty if nothing.
        recurrent: outputs that are fed back, by input.
        weights: the checkpoint that its metadata names; or empty.
        latency_of: what the shares of time are of; empty if not measured.
    """

    file: str
    file_bytes: int
    opset: int | None
    domains: tuple[str, ...]
    map: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    modules: tuple[Item, ...]
    rules: dict[str, int]
    macs: int | None
    unknown_macs_nodes: int
    uncounted: dict[str, int]
    open_dimensions: tuple[str, ...]
    lowered: str = ""
    hint: str = ""
    recurrent: dict[str, str] = dataclasses.field(default_factory=dict)
    weights: str = ""
    latency_of: str = ""

    @property
    def headline(self) -> str:
        """The file, its size and opset."""
        more = f" and {', '.join(self.domains)}" if self.domains else ""
        read = f" ({self.lowered})" if self.lowered else ""
        size = f"{megabytes(self.file_bytes)} MB"
        return f"{self.file}: {size}, opset {self.opset}{more}{read}"

    def lines(self) -> tuple[str, ...]:
        """Return the headline, what the graph lacks, and its checkpoint."""
        return tuple(filter(None, (self.hint, self.headline, self.weights)))

    def tables(self) -> tuple[Table, ...]:
        """Return the interface and the modules."""
        ports = [
            (kind, port.name, port.type, port.shape)
            for kind, side in (("in", self.inputs), ("out", self.outputs))
            for port in side
        ]
        rows = [
            (
                item.module,
                number(item.nodes),
                number(item.parameters),
                megabytes(item.weight_bytes),
                giga(item.macs, item.unknown_macs_nodes, ".3f"),
                _activations(item),
                *self._share(item),
            )
            for item in self.modules
        ]
        # notes below the tables: placement, total MACs, time, recurrence
        rules = ", ".join(f"{count} by {rule}" for rule, count in self.rules.items())
        note = f"nodes placed: {rules}\nGMACs in all: {self._total_macs()}"
        if self.latency_of:
            note += f"\nshare of a frame's time: {self.latency_of}"
        pairs = [f"{to} as {name}" for name, to in self.recurrent.items()]
        back = f"fed back: {', '.join(pairs)}" if pairs else ""
        time = ("time",) if self.latency_of else ()
        counts = ("nodes", "parameters", "MB", "GMACs", "activations MB")
        # the column of time is only there if it was measured
        columns = ("module", *counts, *time)
        return (
            table("Interface", ("", "name", "type", "shape"), ports, back, words=4),
            table(f"Modules (map {self.map})", columns, rows, note),
        )

    def _share(self, item: Item) -> tuple[str, ...]:
        if not self.latency_of:
            return ()
        share = item.latency_share
        return ("-" if share is None else f"{share:.1%}",)

    def _total_macs(self) -> str:
        total = giga(self.macs, 0, ".3f")
        if not self.unknown_macs_nodes:
            return total
        known = "" if self.macs is None else f"at least {total}, "
        found = [f"{count} {reason}" for reason, count in self.uncounted.items()]
        why = ", ".join(found[:_SHOWN]) + (", ..." if len(found) > _SHOWN else "")
        ways = ""
        if self.open_dimensions:
            ways = f"; --set-dim NAME=SIZE for {', '.join(self.open_dimensions)}"
        nodes = "node" if self.unknown_macs_nodes == 1 else "nodes"
        return (
            f"{known}{number(self.unknown_macs_nodes)} {nodes} not counted: {why}{ways}"
        )


def _activations(item: Item) -> str:
    if item.activation_bytes is None:
        return "-"
    least = "at least " if item.unknown_activation_nodes else ""
    return f"{least}{megabytes(item.activation_bytes)}"
