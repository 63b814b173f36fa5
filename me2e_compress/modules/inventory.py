"""What a file holds of a state dict, and what it has more or less."""

import dataclasses
from collections.abc import Callable, Mapping

import onnx_ir as ir

from me2e_compress.modules.itemise import owner_of
from me2e_compress.modules.module_map import ModuleMap

_INTEGERS = (ir.DataType.INT64, ir.DataType.INT32, ir.DataType.BOOL)


@dataclasses.dataclass(frozen=True)
class WeightEntry:
    """One tensor of the state dict or of the file.

    Attributes:
        name: its name there.
        module: the module it counts for; None if nothing tells.
        elements: how many numbers it holds.
        kind: in a state dict "batch-norm statistics", "batch-norm counter" or
            "parameter", which other buffers are called too; in a file "renamed
            weight", "constant" or "integer constant".
    """

    name: str
    module: str | None
    elements: int
    kind: str


@dataclasses.dataclass(frozen=True)
class Inventory:
    """A file against the state dict it was exported from.

    Attributes:
        present: in both, by name and number of elements.
        missing: in the state dict only: folded, merged or never read.
        extra: in the file only: renamed, folded together or made by the exporter.
    """

    present: tuple[WeightEntry, ...]
    missing: tuple[WeightEntry, ...]
    extra: tuple[WeightEntry, ...]


def inventory(
    model: ir.Model,
    modules: ModuleMap,
    module_of: Callable[[ir.Node], str],
    state_dict: Mapping[str, int],
) -> Inventory:
    """Compare a file's initializers with a state dict.

    Args:
        model: the graph.
        modules: its map.
        module_of: the module of a node.
        state_dict: number of elements by name, buffers included.
    """
    stored = {
        name: value
        for graph in (model.graph, *model.graph.subgraphs())
        for name, value in graph.initializers.items()
        if value.const_value is not None
    }
    sizes = {name: _elements(value) for name, value in stored.items()}
    ours = [
        WeightEntry(name, modules.match(name), elements, _kind_in_state_dict(name))
        for name, elements in state_dict.items()
    ]
    return Inventory(
        present=tuple(w for w in ours if sizes.get(w.name) == w.elements),
        missing=tuple(w for w in ours if sizes.get(w.name) != w.elements),
        extra=tuple(
            WeightEntry(
                name, owner_of(value, modules, module_of), sizes[name], _kind(value)
            )
            for name, value in stored.items()
            if state_dict.get(name) != sizes[name]
        ),
    )


def _elements(value: ir.Value) -> int:
    return 0 if value.const_value is None else value.const_value.size


def _kind_in_state_dict(name: str) -> str:
    last = name.rpartition(".")[2]
    if last in ("running_mean", "running_var"):
        return "batch-norm statistics"
    return "batch-norm counter" if last == "num_batches_tracked" else "parameter"


def _kind(value: ir.Value) -> str:
    if value.dtype in _INTEGERS:
        return "integer constant"
    return "renamed weight" if "::" in (value.name or "") else "constant"
