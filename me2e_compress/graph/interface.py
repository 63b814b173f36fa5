"""What a graph promises to the outside."""

import dataclasses
from collections.abc import Iterable

import onnx_ir as ir


@dataclasses.dataclass(frozen=True)
class Port:
    """One input or output: name, ONNX type and shape as text, e.g. ``[1, 6, 'W']``."""

    name: str
    type: str
    shape: str


def interface(model: ir.Model) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    """List the inputs and the outputs: no pass may change these unasked."""
    return _ports(model.graph.inputs), _ports(model.graph.outputs)


def _ports(values: Iterable[ir.Value]) -> tuple[Port, ...]:
    return tuple(Port(v.name or "", str(v.type), str(v.shape)) for v in values)
