"""One pass on a copy of a graph, its contract checked: a result, or the error."""

import dataclasses

import onnx
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import Me2eError, PassError
from me2e_compress.graph.nodes import has_subgraph
from me2e_compress.graph.shapes import without_weights
from me2e_compress.manager import pass_contract
from me2e_compress.manager.strict_shapes import check_shapes
from me2e_compress.passes.base import Context, Pass, PassResult


@dataclasses.dataclass(frozen=True)
class Checked:
    """What a pass returned, found to keep its contract.

    Attributes:
        result: the graph, shapes inferred, and what to say about it.
        digest: of the graph.
    """

    result: PassResult
    digest: str


def attempt(
    current: Pass, model: ir.Model, context: Context, digest: str | None = None
) -> Checked | Me2eError:
    """Run a pass on a clone and check its contract; failures are values here.

    Args:
        current: the pass.
        model: the graph, shapes inferred; it stays as it is.
        context: what the pass may ask for.
        digest: of the graph, if that is known.
    """
    known = graph.digest(model) if digest is None else digest
    try:
        result = current.run(model.clone(), context)
        written = _written(result.model)  # once, to check it and to infer its shapes
        after = pass_contract.check(current, model, result, known, written)
        if result.changes:
            after = _infer(current, model, result.model, after, written)
        return Checked(result, after)
    except Me2eError as error:
        return error
    except Exception as cause:  # whatever a pass may raise: chained, never swallowed
        broken = PassError(f"{current.name} broke: {type(cause).__name__}: {cause}")
        broken.__cause__ = cause
        return broken


def _infer(
    current: Pass,
    before: ir.Model,
    after: ir.Model,
    digest: str,
    written: onnx.ModelProto | None,
) -> str:
    """Infer shapes, those that the pass touched strictly; return the digest then."""
    interface = graph.interface(after)
    graph.infer_shapes(after, written=written)
    check_shapes(current.name, before, after)
    stale = any(has_subgraph(node) for node in after.graph)
    stale |= graph.interface(after) != interface  # an output has a shape now
    return graph.digest(after) if stale else digest


def _written(model: ir.Model) -> onnx.ModelProto | None:
    try:
        return without_weights(model)
    except ir.serde.SerdeError:
        return None  # the contract says why
