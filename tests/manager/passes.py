"""Passes that misbehave, each in one way, and one that does not."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.passes.base import Context, Pass, PassResult


@dataclass(frozen=True)
class Sample(Pass):
    """Runs a function that changes the graph; it says how often it did."""

    name: str  # type: ignore[misc]
    edit: Callable[[ir.Model], int]
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        return PassResult(model, self.edit(model))


@dataclass(frozen=True)
class Lossy(Sample):
    """Promises nothing."""

    exact: ClassVar[bool] = False


@dataclass(frozen=True)
class TurnsTanhIntoSigmoid(Pass):
    """Wrong, and says it is exact."""

    name: ClassVar[str] = "turns-tanh-into-sigmoid"
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        written = _write_sigmoid(model)
        for node in written:
            provenance.inherit(node, [node], by=self.name)
        return PassResult(model, len(written))


def _write_sigmoid(model: ir.Model) -> list[ir.Node]:
    tanhs = [node for node in model.graph if node.op_type == "Tanh"]
    for node in tanhs:
        node.op_type = "Sigmoid"
    return tanhs


def _drop_relu(model: ir.Model) -> int:
    changes = 0
    for node in list(model.graph):
        source = node.inputs[0].producer() if node.inputs[0] else None
        if node.op_type == "Relu" and source and source.op_type == "Sigmoid":
            node.outputs[0].replace_all_uses_with(source.outputs[0])
            model.graph.remove(node, safe=True)
            changes += 1
    return changes


def _break(model: ir.Model) -> int:
    if any(node.op_type == "Tanh" for node in model.graph):
        raise KeyError("no such value")
    return 0


def _rename_output(model: ir.Model) -> int:
    model.graph.outputs[0].name = "other"
    return 1


def _make_up_a_past(model: ir.Model) -> int:
    past = provenance.Provenance("backbone", ("/no/such/node",), ("makes-up-a-past",))
    provenance.stamp(model.graph[0], past)
    return 1


def _forget(model: ir.Model) -> int:
    del model.graph[0].metadata_props[provenance.ORIGINS]
    return 1


def _invalidate(model: ir.Model) -> int:
    model.graph[0].op_type = "NoSuchOperator"
    provenance.inherit(model.graph[0], [model.graph[0]], by="invalidates")
    return 1


def _swap_sizes(model: ir.Model) -> int:
    shape = next(node for node in model.graph if node.op_type == "Shape")
    if shape.inputs[0] is model.graph.inputs[1]:
        return 0
    shape.replace_input_with(0, model.graph.inputs[1])
    provenance.inherit(shape, [shape], by="swaps-sizes")
    return 1


def _remove_dead(model: ir.Model) -> int:
    dead = [node for node in model.graph if node.op_type == "NoSuchOperator"]
    model.graph.remove(dead, safe=True)
    return len(dead)


def _invert(model: ir.Model) -> int:
    factor = model.graph.initializers["factor"]
    (node,) = (use.node for use in factor.uses())
    assert factor.const_value is not None
    if "inverts" in node.metadata_props.get(provenance.PASSES, ""):
        return 0
    node.op_type = {"Mul": "Div", "Div": "Mul"}[node.op_type]
    provenance.inherit(node, [node], by="inverts")
    inverse = np.float32(1) / factor.const_value.numpy()
    factor.const_value = ir.tensor(inverse, name="factor")
    return 1


def _of_weights(
    change: Callable[[np.ndarray], np.ndarray],
) -> Callable[[ir.Model], int]:
    """Return the edit that writes other numbers into every weight."""

    def edit(model: ir.Model) -> int:
        for value in model.graph.initializers.values():
            if value.const_value is not None:
                array = change(value.const_value.numpy())
                value.const_value = ir.tensor(array, name=value.name)
        return len(model.graph.initializers)

    return edit


IDLE = Sample("idle", lambda model: 0)
DROPS_RELU = Sample("drops-relu-of-sigmoid", _drop_relu)
"""Right: a sigmoid is never negative."""
ROUNDS = Sample("rounds", _of_weights(lambda w: np.nextafter(w, np.float32(9e9))))
"""Right, but for the last place of every weight."""
INVERTS = Sample("inverts", _invert)
"""Right: divides by the inverse of a factor, or multiplies."""
REMOVES_DEAD = Sample("remove-dead", _remove_dead)
HALVES = Lossy("halves", _of_weights(lambda w: w / np.float32(2)))
BREAKS = Sample("breaks", _break)
RENAMES_OUTPUT = Sample("renames-output", _rename_output)
CLAIMS_TOO_MUCH = Sample("claims-too-much", lambda model: 3)
DENIES_IT = Sample("denies-it", lambda model: 0 * len(_write_sigmoid(model)))
LEAVES_NO_NAME = Sample("leaves-no-name", lambda model: len(_write_sigmoid(model)))
MAKES_UP_A_PAST = Sample("makes-up-a-past", _make_up_a_past)
FORGETS = Sample("forgets", _forget)
INVALIDATES = Sample("invalidates", _invalidate)
SWAPS_SIZES = Sample("swaps-sizes", _swap_sizes)
"""Wrong where two open dimensions differ, and right where they are equal."""


def scales(by: float) -> Sample:
    """Multiply every weight, and say that it is exact."""
    return Sample("scales", _of_weights(lambda w: w * np.float32(by)))


def leaves(axis: int) -> Sample:
    """Write an axis that does not fit what its reader reads."""

    def edit(model: ir.Model) -> int:
        axes = model.graph.initializers["axes"]
        axes.const_value = ir.tensor(np.array([axis]), name="axes")
        reader = next(iter(axes.consumers()))
        provenance.inherit(reader, [reader], by="leaves")
        return 1

    return Sample("leaves", edit)
