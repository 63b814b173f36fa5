"""Hold a pass to what the manager and the documents promise of passes."""

import dataclasses
import re

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import Me2eError, VerificationError
from me2e_compress.graph import provenance
from me2e_compress.manager import equivalence
from me2e_compress.manager.pass_manager import attempt
from me2e_compress.modules import ModuleMap, detect
from me2e_compress.passes import Context, Pass, PassResult
from me2e_compress.passes.import_normalize import ImportNormalize

_KEBAB = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


def context_for(model: ir.Model, modules: ModuleMap | None = None) -> Context:
    """Make the context that a pass runs in: the given map, or the detected one."""
    return Context(modules if modules is not None else detect(model))


def prepare(model: ir.Model, context: Context) -> ir.Model:
    """Give a copy of a graph as a pass sees it: imported, shapes inferred."""
    copy = model.clone()
    graph.infer_shapes(copy)
    if provenance.missing(copy):
        copy = ImportNormalize().run(copy, context).model
    return copy


def check_pass(
    current: Pass, model: ir.Model, context: Context | None = None
) -> PassResult:
    """Hold a pass to everything the manager and the documents promise of passes.

    It is a frozen dataclass with a kebab-case name and a docstring that shows
    *Given* and *Result*; it leaves its input alone (run on a clone), keeps the
    interface and every node's past, tells the truth about having changed something,
    leaves valid ONNX, gives the same bytes twice, changes nothing the second time
    if it is exact, and then gives the same outputs.

    Args:
        current: the pass.
        model: a graph to try it on; static input shapes let exact passes be run.
        context: module map, frames, seed; None detects the map.

    Returns:
        What the pass gave.

    Raises:
        VerificationError: it broke a promise; the message says which.
        Me2eError: it refused the graph.
    """
    _check_form(current)
    context = context if context is not None else context_for(model)
    ready = prepare(model, context)
    first, again = (_run(current, ready, context) for _ in range(2))
    if graph.digest(first.model) != graph.digest(again.model):
        raise VerificationError(f"{current.name} gives two graphs on two runs")
    if current.exact:
        _check_exact(current, ready, first.model, context)
    return first


def _check_form(current: Pass) -> None:
    cls = type(current)
    # of its own: an undecorated class inherits that of the base, and has no options
    if "__dataclass_params__" not in vars(cls):
        raise VerificationError(f"{cls.__name__} is not a frozen dataclass")
    if _KEBAB.fullmatch(current.name) is None:
        raise VerificationError(f"{current.name!r} is not a name-like-this")
    text = cls.__doc__ or ""
    if "Given:" not in text or "Result:" not in text:
        raise VerificationError(f"{cls.__name__}'s docstring lacks Given: and Result:")
    for field in dataclasses.fields(cls):
        if field.name not in text:
            raise VerificationError(f"{cls.__name__}'s docstring lacks {field.name}")


def _run(current: Pass, ready: ir.Model, context: Context) -> PassResult:
    before = graph.digest(ready)
    found = attempt(current, ready, context, before)
    if isinstance(found, Me2eError):
        raise found
    if graph.digest(ready) != before:
        raise VerificationError(f"{current.name} reached into a clone's source")
    graph.infer_shapes(found.result.model)
    return found.result


def _check_exact(
    current: Pass, before: ir.Model, after: ir.Model, context: Context
) -> None:
    second = _run(current, after, context)
    if second.changes:
        raise VerificationError(
            f"{current.name} is not idempotent: {second.changes} changes on a second"
            " run"
        )
    probe = equivalence.Probe.of(before, context.frames, context.seed, 2)
    found = equivalence.verify((current.name,), before, after, probe)
    if not equivalence.passed(found):
        raise VerificationError(f"{current.name} moved the outputs: {found.errors}")
