"""Prepare the graph for int8: run the passes before it, infer shapes."""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn, Self

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.observers import DEFAULT_METHOD
from me2e_compress.errors import PreconditionError
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context, Pass
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.targets import TARGETS
from me2e_compress.targets.quantized import describe_quantized
from me2e_compress.workflows.checks import load_map

_MOST = "paper{without=[fused-operator]}"
"""The rules that need all ranges that others do: an override may lift those."""


@dataclasses.dataclass(frozen=True, eq=False)
class PreparedGraph:
    """A graph in the state in which the pass that reads ranges finds it.

    `reader` is that pass; None where the recipe has none.
    """

    file: Path
    model: ir.Model
    modules: ModuleMap
    reader: Pass | None

    @classmethod
    def of(
        cls,
        file: Path,
        loaded: ir.Model,
        module_map: str | Path | ModuleMap | None,
        passes: Sequence[Pass] | None = None,
    ) -> Self:
        """Run the passes before the first that reads ranges, unverified.

        A module map of None finds the preset; passes of None stand for the recipe
        ``exact``. A graph that is quantized already, and is to become int8, raises
        PreconditionError.
        """
        chosen = tuple(recipe.load("exact") if passes is None else passes)
        at = next((at for at, each in enumerate(chosen) if each.reads_ranges), None)
        reader = None if at is None else chosen[at]
        # a quantized graph may only be rewritten, not quantized again
        quantized = describe_quantized(loaded)
        if quantized and (reader is None or reader.quantizes):
            raise PreconditionError(
                f"{file}: the graph is quantized already: {quantized}; give the float"
                " graph that it was made of"
            )
        if not isinstance(module_map, ModuleMap):
            module_map = load_map(module_map, loaded)
        # exact passes are verified when the graph is compressed
        manager = PassManager(chosen[:at], verify_frames=0)
        model = manager.run(loaded, Context(module_map)).model
        graph.infer_shapes(model)
        _leave_the_message(model)
        return cls(file, model, module_map, reader)

    @property
    def method(self) -> str:
        """Return how the pass that reads ranges wants them measured."""
        if isinstance(self.reader, QuantizeInt8):
            return self.reader.method_of_ranges
        return (
            self.reader.method if isinstance(self.reader, LowerInt8) else DEFAULT_METHOD
        )

    def tensors(self) -> tuple[str, ...]:
        """Return every tensor that any scheme, rule set or target needs a range of.

        For a quantized graph to be rewritten, these are the tensors without a range in
        it. If there is none, PreconditionError is raised.
        """
        if self.reader is None or self.reader.quantizes:
            return self._of_all() or self._refuse("no node can become int8")
        missing = self.reader.ranged_tensors(self.model, Context(self.modules))
        return missing or self._refuse(
            f"it tells every range that {self.reader.name} needs: none to measure"
        )

    def _of_all(self) -> tuple[str, ...]:
        names: dict[str, None] = {}
        sets = (*RULE_SETS.usable(), _MOST)
        for rules, target in itertools.product(sets, TARGETS.usable()):
            every = QuantizeInt8(
                modules=self.modules.names(), rules=rules, target=target
            )
            plan = every.plan(self.model, Context(self.modules))
            found = TARGETS.parse(target).tensors(plan, self.model)
            names |= dict.fromkeys(found)
        return tuple(names)

    def _refuse(self, reason: str) -> NoReturn:
        raise PreconditionError(f"{self.file}: {reason}")


def _leave_the_message(model: ir.Model) -> None:
    """Copy weights out of the protobuf message that the file was read into.

    A single weight left there would keep the whole message in memory.
    """
    for value in (v for g in model.graphs() for v in g.initializers.values()):
        tensor = value.const_value
        if isinstance(tensor, ir.serde.TensorProtoTensor):
            array = tensor.numpy().copy()
            value.const_value = ir.Tensor(array, dtype=tensor.dtype, name=value.name)
