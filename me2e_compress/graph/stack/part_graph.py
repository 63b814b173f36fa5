"""The inputs and outputs of one file of a stack."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

import onnx_ir as ir

from me2e_compress.errors import GraphError
from me2e_compress.graph.files import load
from me2e_compress.graph.recurrence import SessionPort, declared_pairs


@dataclasses.dataclass(frozen=True)
class PartGraph:
    """One ONNX file of a stack, and its interface.

    A port of unknown shape has an empty one.
    """

    part: str
    path: Path
    inputs: Mapping[str, SessionPort]
    outputs: Mapping[str, SessionPort]
    metadata: Mapping[str, str]
    model: ir.Model = dataclasses.field(repr=False)

    @classmethod
    def load(cls, part: str, path: Path) -> Self:
        """Read a file; GraphError if it is missing or not a graph."""
        model = load(path)
        sides = _ports(model.graph.inputs), _ports(model.graph.outputs)
        return cls(part, path, *sides, dict(model.metadata_props), model)

    def recurrent(self) -> dict[str, str | None]:
        """Return the output declared for each input; None if it is not fed back."""
        try:
            named = declared_pairs(self.metadata)
        except GraphError as error:
            raise GraphError(f"{self.path}: {error}") from error
        if named == {}:
            return dict.fromkeys(self.inputs)
        return named or {}


def misfit(given: SessionPort, taken: SessionPort) -> bool:
    """Return whether an output can never feed an input."""
    if given.type != taken.type:
        return True
    if not given.shape or not taken.shape:  # not known
        return False
    return len(given.shape) != len(taken.shape) or any(
        isinstance(one, int) and isinstance(other, int) and one != other
        for one, other in zip(given.shape, taken.shape, strict=True)
    )


def form(port: SessionPort) -> str:
    """Describe type and shape: ``float [1, 6, 2]``."""
    element = port.type.removeprefix("tensor(").removesuffix(")")
    return f"{element} {list(port.shape)}"


def _ports(values: Sequence[ir.Value]) -> dict[str, SessionPort]:
    """Describe values as onnxruntime does."""
    return {
        str(value.name): SessionPort(_type(value), _shape(value)) for value in values
    }


def _type(value: ir.Value) -> str:
    if isinstance(value.type, ir.TensorType) and value.dtype is not None:
        return f"tensor({value.dtype.name.lower()})"
    return str(value.type)


def _shape(value: ir.Value) -> tuple[int | str | None, ...]:
    if value.shape is None:
        return ()
    return tuple(each if isinstance(each, int) else each.value for each in value.shape)
