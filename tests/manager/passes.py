"""Passes that misbehave, each in one way, and one that does not."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.passes.base import Context, Pass, PassResult


@dataclass(frozen=True)
class _Sample(Pass):
    """Base of the samples.

    Given:   x
    Result:  x
    """

    name: ClassVar[str] = "sample"
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        return PassResult(model, 0)


@dataclass(frozen=True)
class Idle(_Sample):
    name: ClassVar[str] = "idle"


@dataclass(frozen=True)
class DropsReluOfSigmoid(_Sample):
    """Right: a sigmoid is never negative."""

    name: ClassVar[str] = "drops-relu-of-sigmoid"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        changes = 0
        for node in list(model.graph):
            source = node.inputs[0].producer() if node.inputs[0] else None
            if node.op_type == "Relu" and source and source.op_type == "Sigmoid":
                node.outputs[0].replace_all_uses_with(source.outputs[0])
                model.graph.remove(node, safe=True)
                changes += 1
        return PassResult(model, changes)


@dataclass(frozen=True)
class TurnsTanhIntoSigmoid(_Sample):
    """Wrong, and says it is exact."""

    name: ClassVar[str] = "turns-tanh-into-sigmoid"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        changes = 0
        for node in model.graph:
            if node.op_type == "Tanh":
                node.op_type = "Sigmoid"
                provenance.inherit(node, [node], by=self.name)
                changes += 1
        return PassResult(model, changes)


@dataclass(frozen=True)
class Rounds(_Sample):
    """Right, but for the last place of every weight."""

    name: ClassVar[str] = "rounds"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        for value in model.graph.initializers.values():
            if value.const_value is not None:
                data = np.nextafter(value.const_value.numpy(), np.float32(9e9))
                value.const_value = ir.tensor(data, name=value.name)
        return PassResult(model, len(model.graph.initializers))


@dataclass(frozen=True)
class Scales(_Sample):
    """Multiplies every weight, and says it is exact."""

    name: ClassVar[str] = "scales"
    by: float = 1.0

    def run(self, model: ir.Model, context: Context) -> PassResult:
        for value in model.graph.initializers.values():
            if value.const_value is not None:
                data = value.const_value.numpy() * np.float32(self.by)
                value.const_value = ir.tensor(data, name=value.name)
        return PassResult(model, len(model.graph.initializers))


@dataclass(frozen=True)
class Breaks(_Sample):
    name: ClassVar[str] = "breaks"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        if any(node.op_type == "Tanh" for node in model.graph):
            raise KeyError("no such value")
        return PassResult(model, 0)


@dataclass(frozen=True)
class Witness(_Sample):
    """Writes down the shape of every value that it is shown."""

    name: ClassVar[str] = "witness"
    shapes: list[str] = field(default_factory=list)

    def run(self, model: ir.Model, context: Context) -> PassResult:
        values = [value for node in model.graph for value in node.outputs]
        self.shapes.extend(str(value.shape) for value in values)
        return PassResult(model, 0)


@dataclass(frozen=True)
class RenamesOutput(_Sample):
    name: ClassVar[str] = "renames-output"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        model.graph.outputs[0].name = "other"
        return PassResult(model, 1)


@dataclass(frozen=True)
class ClaimsTooMuch(_Sample):
    name: ClassVar[str] = "claims-too-much"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        return PassResult(model, 3)


@dataclass(frozen=True)
class DeniesIt(_Sample):
    name: ClassVar[str] = "denies-it"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        return PassResult(TurnsTanhIntoSigmoid().run(model, context).model, 0)


@dataclass(frozen=True)
class LeavesNoName(_Sample):
    name: ClassVar[str] = "leaves-no-name"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        return TurnsTanhIntoSigmoid().run(model, context)


@dataclass(frozen=True)
class MakesUpAPast(_Sample):
    name: ClassVar[str] = "makes-up-a-past"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        node = model.graph[0]
        past = provenance.Provenance("backbone", ("/no/such/node",), (self.name,))
        provenance.stamp(node, past)
        return PassResult(model, 1)


@dataclass(frozen=True)
class Forgets(_Sample):
    name: ClassVar[str] = "forgets"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        del model.graph[0].metadata_props[provenance.ORIGINS]
        return PassResult(model, 1)


@dataclass(frozen=True)
class Invalidates(_Sample):
    name: ClassVar[str] = "invalidates"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        model.graph[0].op_type = "NoSuchOperator"
        provenance.inherit(model.graph[0], [model.graph[0]], by=self.name)
        return PassResult(model, 1)


@dataclass(frozen=True)
class Halves(_Sample):
    """Lossy: halves every weight."""

    name: ClassVar[str] = "halves"
    exact: ClassVar[bool] = False

    def run(self, model: ir.Model, context: Context) -> PassResult:
        for value in model.graph.initializers.values():
            if value.const_value is not None:
                data = value.const_value.numpy() * np.float32(0.5)
                value.const_value = ir.tensor(data, name=value.name)
        return PassResult(model, len(model.graph.initializers), ("halved",))


@dataclass(frozen=True)
class SwapsSizes(_Sample):
    """Wrong where two open dimensions differ, and right where they are equal."""

    name: ClassVar[str] = "swaps-sizes"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        shape = next(node for node in model.graph if node.op_type == "Shape")
        if shape.inputs[0] is model.graph.inputs[1]:
            return PassResult(model, 0)
        shape.replace_input_with(0, model.graph.inputs[1])
        provenance.inherit(shape, [shape], by=self.name)
        return PassResult(model, 1)


@dataclass(frozen=True)
class RemovesDead(_Sample):
    name: ClassVar[str] = "remove-dead"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        dead = [node for node in model.graph if node.op_type == "NoSuchOperator"]
        model.graph.remove(dead, safe=True)
        return PassResult(model, len(dead))


@dataclass(frozen=True)
class Leaves(_Sample):
    """Writes an attribute or an axis that does not fit what a node reads."""

    name: ClassVar[str] = "leaves"
    axes: int = 0

    def run(self, model: ir.Model, context: Context) -> PassResult:
        axes = model.graph.initializers["axes"]
        if axes.const_value is None or int(axes.const_value.numpy()[0]) == self.axes:
            return PassResult(model, 0)
        axes.const_value = ir.tensor(np.array([self.axes]), name="axes")
        reader = next(iter(axes.consumers()))
        provenance.inherit(reader, [reader], by=self.name)
        return PassResult(model, 1)


@dataclass(frozen=True)
class SwapsTerms(_Sample):
    """Right: a sum is the same in the other order."""

    name: ClassVar[str] = "swaps-terms"

    def run(self, model: ir.Model, context: Context) -> PassResult:
        epsilon, sums = model.graph.initializers["e"], 0
        for node in model.graph:
            if node.op_type == "Add" and node.inputs[0] is epsilon:
                node.replace_input_with(0, node.inputs[1])
                node.replace_input_with(1, epsilon)
                sums += 1
        return PassResult(model, sums)
