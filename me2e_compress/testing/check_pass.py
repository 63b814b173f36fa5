"""Check what the manager and the documents promise of passes."""

import dataclasses

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import VerificationError
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.assign import map_of
from me2e_compress.manager import equivalence
from me2e_compress.manager.attempt import attempt
from me2e_compress.manager.verification_inputs import VerificationInputs
from me2e_compress.passes import Context, Pass, PassResult
from me2e_compress.passes.import_normalize import ImportNormalize
from me2e_compress.testing.form import check_class, require


def check_pass(
    current: Pass, model: ir.Model, context: Context | None = None
) -> PassResult:
    """Check everything that the manager and the documents promise of passes.

    A pass is a frozen dataclass with a kebab-case name and a docstring that shows
    *Given* and *Result* and names every option. It leaves its input alone (it is given
    a copy), keeps the interface, reports whether it changed anything, leaves valid ONNX
    and makes the same graph twice. Every node keeps its provenance; a new or changed
    one names the pass and, as its origins, nodes that were there. If the pass is exact,
    a second run changes nothing and the outputs are the same.

    ``model`` is a graph to try it on; static input shapes let exact passes be run.
    ``context`` None detects the module map, and takes a graph of no known stack as one
    module. Returns the pass's own result.

    Raises:
        VerificationError: it broke a promise; the message says which.
        Me2eError: it refused the graph.
    """
    # its class
    check_class(current)
    cls, text = type(current), type(current).__doc__ or ""
    has_examples = "Given:" in text and "Result:" in text
    require(has_examples, f"{cls.__name__}'s docstring lacks Given: and Result:")
    for field in dataclasses.fields(cls):
        require(field.name in text, f"{cls.__name__}'s docstring lacks {field.name}")
    # a graph as a pass sees it: imported, shapes inferred
    context = context if context is not None else Context(map_of(model, None))
    ready = model.clone()
    graph.infer_shapes(ready)
    if provenance.missing(ready):
        ready = ImportNormalize().run(ready, context).model
    # two runs
    first, again = (_run(current, ready, context) for _ in range(2))
    same = graph.digest(first.model) == graph.digest(again.model)
    require(same, f"{current.name} gives two graphs on two runs")
    if current.exact:
        _check_exact(current, ready, first.model, context)
    return first


def _run(current: Pass, ready: ir.Model, context: Context) -> PassResult:
    before = graph.digest(ready)
    result, _ = attempt(current, ready, context, before)
    if graph.digest(ready) != before:
        raise VerificationError(f"{current.name} reached into a clone's source")
    return result


def _check_exact(
    current: Pass, before: ir.Model, after: ir.Model, context: Context
) -> None:
    """Check that a second run changes nothing and both outputs are the same."""
    try:
        second = _run(current, after, context)
    except VerificationError as error:
        raise VerificationError(
            f"on its second run, {error}; is something left that nothing reads"
            " (remove_dead)?"
        ) from error
    again = f"{second.changes} changes on a second run"
    require(not second.changes, f"{current.name} is not idempotent: {again}")
    # the outputs are the same
    inputs = VerificationInputs.of(before, context.frames, context.seed, 2)
    check = equivalence.verify((current.name,), before, after, inputs)
    if not check.passed:
        raise VerificationError(f"{current.name} moved the outputs: {check.errors}")
