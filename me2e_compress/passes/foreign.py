"""Run what was written for graphsurgeon as a pass of this toolkit."""

import dataclasses
from collections.abc import Callable

import onnx_graphsurgeon as gs
import onnx_ir as ir

from me2e_compress.base.errors import PassError
from me2e_compress.graph import digest, node_count, provenance
from me2e_compress.graph.surgeon import from_graphsurgeon, to_graphsurgeon
from me2e_compress.passes.base import Context, Pass, PassResult

__all__ = ["SurgeonFunction"]


@dataclasses.dataclass(frozen=True)
class SurgeonFunction(Pass):
    """Run a function over the graph as onnx-graphsurgeon sees it.

    Modules, origins and other metadata, which graphsurgeon drops, are restored; new
    nodes belong to the module of their neighbours. In the function, call
    ``fold_constants`` and ``cleanup`` with ``recurse_functions=False``.

    Given:
        a = Relu(x)  ;  y = Relu(a)     and a function that drops the second Relu

    Result:
        y = Relu(x)                     with the provenance of the first

    Attributes:
        function: takes the graph, and changes it (returning None) or returns another.
        name: the name in reports.
        exact: whether it promises the same outputs.
        changes_interface: whether it may change inputs and outputs.
    """

    function: Callable[[gs.Graph], gs.Graph | None]
    # of the object, not of the class: each function has its own
    _: dataclasses.KW_ONLY
    name: str  # type: ignore[misc]
    exact: bool = False  # type: ignore[misc]
    changes_interface: bool = False  # type: ignore[misc]

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Run the function on a copy; a result that is not a graph is a PassError."""
        surgeon = to_graphsurgeon(model)
        returned = self.function(surgeon)
        if returned is not None and not isinstance(returned, gs.Graph):
            raise PassError(
                f"{self.name} returned a {type(returned).__name__}, not a graph or None"
            )
        # Restore what graphsurgeon drops
        edited = surgeon if returned is None else returned
        result = from_graphsurgeon(edited, model, by=self.name)
        if digest(result) == digest(model):
            return PassResult(model, 0)
        provenance.sign(model, result, self.name)
        return PassResult(result, max(1, abs(node_count(model) - node_count(result))))
