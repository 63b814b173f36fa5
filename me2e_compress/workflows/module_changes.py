"""Compare the modules of a graph before and after a compression."""

import dataclasses
from pathlib import Path

from me2e_compress import graph
from me2e_compress.graph.modules import Item
from me2e_compress.workflows.checks import load_map
from me2e_compress.workflows.inspect import weigh
from me2e_compress.workflows.result import (
    AT_LEAST,
    Result,
    Table,
    giga,
    megabytes,
    number,
    table,
)


@dataclasses.dataclass(frozen=True, repr=False)
class ModuleChanges(Result):
    """The modules before and after; a module that is gone is missing in the latter."""

    before: tuple[Item, ...]
    after: tuple[Item, ...]

    @property
    def headline(self) -> str:
        """The size of all weights, and the number of modules left."""
        before, after = (
            megabytes(sum(item.weight_bytes for item in side))
            for side in (self.before, self.after)
        )
        left = f"{len(self.after)} of {len(self.before)} modules"
        return f"{before} MB of weights, now {after} in {left}"

    def lines(self) -> tuple[str, ...]:
        """Return no line: the table says everything."""
        return ()

    def tables(self) -> tuple[Table, ...]:
        """Return each module before and after."""
        rows = []
        for item, now in self._pairs():
            nodes, size = (now.nodes, now.weight_bytes) if now else (0, 0)
            rows.append(
                (
                    item.module,
                    f"{item.nodes} → {nodes}",
                    number(item.parameters),
                    f"{megabytes(item.weight_bytes)} → {megabytes(size)}",
                    f"{_gmacs(item)} → {_gmacs(now)}",
                )
            )
        columns = ("module", "nodes", "parameters", "weights MB", "GMACs")
        note = "before: once imported, its shape arithmetic done"
        if any(item.unknown_macs_nodes for item in (*self.before, *self.after)):
            note += f"\n{AT_LEAST}"
        return (table("Module by module", columns, rows, note),)

    def _pairs(self) -> list[tuple[Item, Item | None]]:
        held = {item.module: item for item in self.after}
        return [(item, held.get(item.module)) for item in self.before]


def _gmacs(item: Item | None) -> str:
    return giga(0) if item is None else giga(item.macs, item.unknown_macs_nodes)


def compare_modules(before: Path, after: Path) -> ModuleChanges:
    """Weigh the modules of two files, each by the preset that fits it."""
    loaded = [graph.load(path) for path in (before, after)]
    return ModuleChanges(*(weigh(each, load_map(None, each)) for each in loaded))
