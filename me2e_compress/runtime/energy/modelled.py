"""Model the energy of a graph's arithmetic and memory traffic from published figures.

Nothing is measured: control, caches and leakage are not included. The figures compare
graphs; they do not predict a device and never stand beside measured joules.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.display import Displayed, Table, megabytes, table
from me2e_compress.errors import EnergyError
from me2e_compress.graph.activations import VIEWS, as_written, value_bytes

Number = Literal["int8", "float16", "float32"]
"""The number type of the factors of a product."""


@dataclass(frozen=True)
class EnergyCosts:
    """Published energies of one silicon process, in picojoules.

    ``mac_pj`` is that of a multiply-accumulate by type of the factors, with sums in
    int32 or float32; ``byte_pj`` that of a byte from or to external memory.
    """

    mac_pj: Mapping[Number, float]
    byte_pj: float
    source: str


PROCESSES: Mapping[str, EnergyCosts] = {
    "45nm": EnergyCosts(
        {"int8": 0.2 + 0.1, "float16": 1.1 + 0.9, "float32": 3.7 + 0.9},
        1_300 / 8,
        "Horowitz, ISSCC 2014, fig. 1.1.9: 45 nm, 0.9 V; DRAM 1.3 to 2.6 nJ for 64"
        " bits, the lower",
    ),
    "7nm": EnergyCosts(
        {"int8": 0.07 + 0.03, "float16": 0.34 + 0.38, "float32": 1.31 + 0.38},
        350 / 8,
        "Jouppi and others, Ten Lessons (TPUv4i), ISCA 2021, table 2: 7 nm; HBM2 250 to"
        " 450 pJ for 64 bits, the middle",
    ),
}
"""Processes by name; both papers give the same kinds of operation."""

DEFAULT_PROCESS = "7nm"
_INT8 = (ir.DataType.INT8, ir.DataType.UINT8)
_FLOAT16 = (ir.DataType.FLOAT16, ir.DataType.BFLOAT16)


@dataclass(frozen=True, repr=False)
class ModelledEnergy(Displayed):
    """Modelled energy of one frame; a lower bound where nodes are not counted.

    Attributes:
        modelled_j_per_frame: joules; None where no node could be counted.
        mac_j: joules of multiply-accumulates.
        memory_j: joules of weights and activations from and to external memory.
        macs: multiply-accumulates by type of the factors.
        weight_bytes: weights, read once a frame.
        activation_bytes: activations read and written by multiplying nodes; all other
            nodes are assumed to be fused into these.
        by_module: joules of each module.
        unknown_nodes: number of nodes that are not counted.
        process: ``45nm`` or ``7nm``.
        source: where the figures of the process are published.
    """

    modelled_j_per_frame: float | None
    mac_j: float
    memory_j: float
    macs: Mapping[str, int]
    weight_bytes: int
    activation_bytes: int
    by_module: Mapping[str, float] = field(default_factory=dict)
    unknown_nodes: int = 0
    process: str = DEFAULT_PROCESS
    source: str = ""

    @property
    def headline(self) -> str:
        """The modelled millijoules per frame, and the process."""
        if self.modelled_j_per_frame is None:
            return f"modelled energy: nodes not counted: {self.unknown_nodes}"
        least = "at least " if self.unknown_nodes else ""
        return (
            f"modelled energy: {least}{1e3 * self.modelled_j_per_frame:.4g} mJ a frame,"
            f" {self.process}: to compare graphs, not to tell what a device takes"
        )

    def tables(self) -> tuple[Table, ...]:
        """Return millijoules by module, with MACs and bytes in the note."""
        whole = self.mac_j + self.memory_j
        rows = [
            (module, f"{1e3 * joules:.3f}", f"{joules / whole:.1%}" if whole else "-")
            for module, joules in self.by_module.items()
        ]
        # The note has the totals, and the source of the figures.
        macs = ", ".join(
            f"{count / 1e9:.3f} G {number}" for number, count in self.macs.items()
        )
        note = (
            f"{self.headline}\n"
            f"MACs {1e3 * self.mac_j:.3f} mJ ({macs or 'none'}); weights"
            f" {megabytes(self.weight_bytes)} MB and activations"
            f" {megabytes(self.activation_bytes)} MB {1e3 * self.memory_j:.3f} mJ\n"
            f"{self.source}"
        )
        title = f"Modelled energy ({self.process}), not measured"
        return (table(title, ("module", "modelled mJ", "share"), rows, note),)


@dataclass(frozen=True)
class _Traffic:
    """One multiplying node."""

    module: str
    number: Number
    macs: int
    weight_bytes: int
    activation_bytes: int


def modelled_energy(
    model: ir.Model,
    process: str = DEFAULT_PROCESS,
    module_of: Callable[[ir.Node], str] = lambda node: "model",
) -> ModelledEnergy:
    """Add up the energy of a frame's products and their operands.

    A product counts as int8 where both factors are: in integer operators, and between
    QuantizeLinear and DequantizeLinear. Int8 weights of a float product count as int8
    for memory only. Shapes of the graph must be inferred.
    """
    costs = costs_of(process)
    found, unknown = _multiplying(model, module_of)
    # Add up by module and by number type.
    by_module: defaultdict[str, float] = defaultdict(float)
    macs: defaultdict[str, int] = defaultdict(int)
    for each in found:
        by_module[each.module] += _mac_j(each, costs) + _memory_j(each, costs)
        macs[each.number] += each.macs
    # There is no figure where no node could be counted.
    mac_j = sum(_mac_j(each, costs) for each in found)
    memory_j = sum(_memory_j(each, costs) for each in found)
    return ModelledEnergy(
        mac_j + memory_j if found or not unknown else None,
        mac_j,
        memory_j,
        dict(macs),
        sum(each.weight_bytes for each in found),
        sum(each.activation_bytes for each in found),
        dict(by_module),
        unknown,
        process,
        costs.source,
    )


def costs_of(process: str) -> EnergyCosts:
    """Return the figures of a process; EnergyError if there is none of that name."""
    if process not in PROCESSES:
        there = ", ".join(PROCESSES)
        raise EnergyError(f"no process {process!r}; there are {there}")
    return PROCESSES[process]


def _mac_j(each: _Traffic, costs: EnergyCosts) -> float:
    return each.macs * costs.mac_pj[each.number] * 1e-12


def _memory_j(each: _Traffic, costs: EnergyCosts) -> float:
    return (each.weight_bytes + each.activation_bytes) * costs.byte_pj * 1e-12


def _multiplying(
    model: ir.Model, module_of: Callable[[ir.Node], str]
) -> tuple[list[_Traffic], int]:
    """Weigh the multiplying nodes; count those whose shapes are unknown."""
    count, seen = graph.macs_counter(model), set[str]()
    weighed = [
        None if macs is None else _traffic(node, macs, module_of(node), seen)
        for node in model.graph.all_nodes()
        if (macs := count(node)) != 0
    ]
    found = [each for each in weighed if each is not None]
    return found, len(weighed) - len(found)


def _traffic(node: ir.Node, macs: int, module: str, seen: set[str]) -> _Traffic | None:
    """Weigh a node; None where a shape is open.

    A weight counts where it is read first: ``seen`` holds the names counted and grows.
    """
    weights, activations = 0, 0
    stored = [_stored(value) for value in node.inputs if value is not None]
    # Inputs are activations, or weights not counted before.
    for value in stored:
        size = value_bytes(value)
        if size is None:
            return None
        if not _is_weight(value):
            activations += size
        elif value.name not in seen:
            seen.add(str(value.name))
            weights += size
    # Outputs count in the type in which they are written.
    for value in node.outputs:
        size = value_bytes(as_written(value))
        if size is None:
            return None
        activations += size
    return _Traffic(module, _number(node, stored), macs, weights, activations)


def _number(node: ir.Node, stored: list[ir.Value]) -> Number:
    """Return the number type of a product: its first two operands decide."""
    types = [value.dtype for value in stored[:2]]
    if node.op_type.startswith("QLinear"):  # data, scale, zero point, weight, ...
        types = [stored[0].dtype]
    if types and all(each in _INT8 for each in types):
        return "int8"
    read = [value.dtype for value in node.inputs if value is not None]
    return "float16" if read and read[0] in _FLOAT16 else "float32"


def _stored(value: ir.Value) -> ir.Value:
    """Return the value in memory: the integers before a DequantizeLinear."""
    at = value
    while (node := at.producer()) is not None and node.inputs and node.inputs[0]:
        if node.op_type == "DequantizeLinear":
            return node.inputs[0]
        if node.op_type not in VIEWS:
            break
        at = node.inputs[0]
    return value


def _is_weight(value: ir.Value) -> bool:
    """Return whether a value is stored in the file, possibly before quantization."""
    node = value.producer()
    if node is not None and node.op_type == "QuantizeLinear" and node.inputs[0]:
        return node.inputs[0].const_value is not None
    return value.const_value is not None
