"""What a graph holds: interface; nodes, parameters, MACs, modelled energy by module."""

import dataclasses
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph, recipe
from me2e_compress.errors import GraphError
from me2e_compress.graph import Port, provenance
from me2e_compress.graph.macs import why_uncounted
from me2e_compress.graph.opset import lowered
from me2e_compress.manager import PassManager
from me2e_compress.modules import Item, ModuleMap, assign, itemise
from me2e_compress.passes import Context
from me2e_compress.passes.fix_shapes import FixShapes, open_dimensions
from me2e_compress.runtime.energy.modelled import (
    DEFAULT_PROCESS,
    ModelledEnergy,
    costs_of,
    modelled_energy,
)
from me2e_compress.runtime.recurrence import recurrent_inputs
from me2e_compress.workflows.checks import lacking_shapes, load_map, model_path
from me2e_compress.workflows.result import (
    Result,
    Table,
    giga,
    megabytes,
    number,
    table,
)
from me2e_compress.zoo.weights_record import named_weights

_SHOWN = 8
"""Operators of unknown MACs that are named."""

_SHAPES = "import-normalize,fold-constants{through_compute=false}"


@dataclasses.dataclass(frozen=True, repr=False)
class InspectResult(Result):
    """What a file holds.

    Attributes:
        file: its name.
        file_bytes: with the weights beside it.
        opset: of the default domain.
        lowered: what was changed so that onnxruntime reads it; empty if nothing was.
        hint: what the graph lacks, of which more could be known; empty if nothing.
        domains: further operator domains.
        map: the module map that was used.
        inputs: what it takes.
        outputs: what it answers.
        modules: module by module.
        rules: how many nodes each rule of the map placed.
        macs: multiply-accumulates of the nodes whose count is known, all modules
            together; None if none is.
        unknown_macs_nodes: how many nodes are not in ``macs``.
        uncounted: why, with the number of nodes.
        open_dimensions: of the inputs, by name: MACs wait for their sizes.
        recurrent: inputs that are fed back from frame to frame, with the output.
        modelled_energy: what its MACs and bytes would take; None: not asked for.
        weights: the checkpoint that its metadata names, in a line; empty: none.
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
    modelled_energy: ModelledEnergy | None = None
    weights: str = ""

    @property
    def headline(self) -> str:
        """File, size, opset."""
        more = f" and {', '.join(self.domains)}" if self.domains else ""
        read = f" ({self.lowered})" if self.lowered else ""
        size = f"{megabytes(self.file_bytes)} MB"
        return f"{self.file}: {size}, opset {self.opset}{more}{read}"

    def lines(self) -> tuple[str, ...]:
        """Return the headline, what the graph lacks, and what it was made of."""
        return tuple(filter(None, (self.hint, self.headline, self.weights)))

    def tables(self) -> tuple[Table, ...]:
        """Return the interface, and the modules."""
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
            )
            for item in self.modules
        ]
        rules = ", ".join(f"{count} by {rule}" for rule, count in self.rules.items())
        note = f"nodes placed: {rules}\nGMACs in all: {self._total_macs()}"
        pairs = [f"{to} as {name}" for name, to in self.recurrent.items()]
        back = f"fed back: {', '.join(pairs)}" if pairs else ""
        columns = ("module", "nodes", "parameters", "MB", "GMACs")
        modelled = self.modelled_energy
        return (
            table("Interface", ("", "name", "type", "shape"), ports, back, words=4),
            table(f"Modules (map {self.map})", columns, rows, note),
            *(() if modelled is None else modelled.tables()),
        )

    def _total_macs(self) -> str:
        """Write the MACs of the graph, and of how many nodes they are not known."""
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

    def records(self) -> list[dict[str, object]]:
        """Return a row a module."""
        return [dataclasses.asdict(item) for item in self.modules]

    def to_json(self) -> object:
        """Return everything."""
        return dataclasses.asdict(self)


def inspect(
    model: str | Path,
    module_map: str | Path | None = None,
    dims: Mapping[str, int] | None = None,
    process: str | None = None,
) -> InspectResult:
    """Read a graph and weigh its modules.

    Args:
        model: an ONNX file, or the name of one that ships.
        module_map: preset or TOML file; None finds the preset.
        dims: sizes that open dimensions of the inputs are given first.
        process: model the energy of a frame by the figures of this silicon process,
            ``45nm`` or ``7nm``; None does not.

    Raises:
        EnergyError: no such process.
        GraphError: no such model.
        PreconditionError: no input has such a dimension.
        ModuleMapError: no such map.
    """
    if process is not None:
        costs_of(process)
    path = model_path(model)
    loaded = graph.load(path)
    modules = load_map(module_map, loaded)
    if dims:
        loaded = FixShapes(dims).run(loaded, Context(modules)).model
    placed = assign(loaded, modules)
    inputs, outputs = graph.interface(loaded)
    items = itemise(loaded, modules, placed.module_of)
    folded = _folded(loaded, modules)
    costs = {item.module: item for item in _costs(folded, modules)}
    fed_back, wrong = _fed_back(loaded)
    total = sum(item.macs or 0 for item in costs.values())
    unknown = sum(item.unknown_macs_nodes or 0 for item in costs.values())
    return InspectResult(
        path.name,
        graph.file_bytes(path),
        loaded.opset_imports.get(""),
        tuple(sorted(domain for domain in loaded.opset_imports if domain)),
        modules.name,
        inputs,
        outputs,
        tuple(_with_cost(item, costs.get(item.module)) for item in items),
        {str(rule): count for rule, count in placed.rules().items()},
        total if total or not unknown else None,
        unknown,
        _uncounted(folded),
        open_dimensions(loaded),
        lowered(loaded),
        "; ".join(filter(None, (lacking_shapes(loaded), wrong))),
        fed_back,
        None
        if process is None
        else modelled_energy(folded, process, provenance.module_of),
        named_weights(loaded.metadata_props),
    )


def model_energy(
    model: str | Path,
    process: str = DEFAULT_PROCESS,
    module_map: str | Path | None = None,
) -> ModelledEnergy:
    """Model the energy of a frame of a file; see :func:`modelled_energy` for a graph.

    Args:
        model: an ONNX file, or the name of one that ships.
        process: whose figures: ``45nm`` or ``7nm``.
        module_map: preset or TOML file; None finds the preset.

    Raises:
        EnergyError: no such process.
        GraphError: no such model.
        ModuleMapError: no such map.
    """
    costs_of(process)
    loaded = graph.load(model_path(model))
    folded = _folded(loaded, load_map(module_map, loaded))
    return modelled_energy(folded, process, provenance.module_of)


def _fed_back(model: ir.Model) -> tuple[dict[str, str], str]:
    """Pair inputs with the outputs that are fed back; say why that cannot be done."""
    try:
        return recurrent_inputs(model), ""
    except GraphError as error:
        return {}, str(error)


def _with_cost(item: Item, cost: Item | None) -> Item:
    """Return what a module holds as it stands in the file, with its MACs."""
    if cost is None:
        return item
    return dataclasses.replace(
        item, macs=cost.macs, unknown_macs_nodes=cost.unknown_macs_nodes
    )


def weigh(model: ir.Model, modules: ModuleMap) -> tuple[Item, ...]:
    """Weigh the modules once the shape arithmetic is done, which MACs need to know."""
    return _costs(_folded(model, modules), modules)


def _folded(model: ir.Model, modules: ModuleMap) -> ir.Model:
    """Return a graph imported, its shape arithmetic done, its shapes inferred."""
    if provenance.missing(model):
        manager = PassManager(recipe.parse(_SHAPES), verify_frames=0)
        model = manager.run(model, Context(modules)).model
    graph.infer_shapes(model)
    return model


def _costs(model: ir.Model, modules: ModuleMap) -> tuple[Item, ...]:
    return itemise(model, modules, provenance.module_of, graph.macs_counter(model))


def _uncounted(model: ir.Model) -> dict[str, int]:
    """Count the nodes of unknown MACs by the reason, most first."""
    count = graph.macs_counter(model)
    unknown = [node for node in model.graph.all_nodes() if count(node) is None]
    return dict(Counter(map(why_uncounted, unknown)).most_common())
