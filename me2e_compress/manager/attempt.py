"""One pass on a copy of a graph, its contract checked: a result, or the error."""

import dataclasses

import onnx
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import Me2eError, PassError
from me2e_compress.graph.shapes import without_weights
from me2e_compress.manager import pass_contract
from me2e_compress.passes.base import Context, Pass, PassResult


@dataclasses.dataclass(frozen=True)
class Checked:
    """What a pass returned, found to keep its contract.

    Attributes:
        result: the graph and what to say about it.
        digest: of the graph.
        written: the graph as ONNX reads it, without its large weights: to check it and
            to infer its shapes, it is written once. None if it cannot be written.
    """

    result: PassResult
    digest: str
    written: onnx.ModelProto | None


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
        written = _written(result.model)
        after = pass_contract.check(current, model, result, known, written)
        return Checked(result, after, written)
    except Me2eError as error:
        return error
    except Exception as cause:  # whatever a pass may raise: chained, never swallowed
        broken = PassError(f"{current.name} broke: {type(cause).__name__}: {cause}")
        broken.__cause__ = cause
        return broken


def _written(model: ir.Model) -> onnx.ModelProto | None:
    try:
        return without_weights(model)
    except ir.serde.SerdeError:
        return None  # the contract says why
