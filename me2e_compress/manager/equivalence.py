"""Do two graphs give the same outputs?

Outputs that a graph draws at random at every run cannot be compared.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress.base.display import plural
from me2e_compress.base.errors import FramesError, GraphError, Me2eError
from me2e_compress.fidelity.engine_loss import find_first_difference
from me2e_compress.graph.nodes import bodies_of, draws, reads_of
from me2e_compress.manager import pieces
from me2e_compress.manager.report import Verification
from me2e_compress.manager.verification_inputs import (
    NUDGES,
    TOLERANCES,
    Outputs,
    VerificationInputs,
    relative_error,
    relative_errors,
    tolerances,
)
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.session import Session, replay, run_once

_BODY = "body"
"""Domain in which a body is run: no kernel is registered for it."""

TryFirst: TypeAlias = Callable[[ir.Model, str, Frames | None], None]
"""Opens a graph before this process does, and may refuse it."""


def verify(
    passes: tuple[str, ...],
    before: ir.Model,
    after: ir.Model,
    inputs: VerificationInputs,
) -> Verification:
    """Compare two graphs on the same inputs; one that no longer runs differs by inf.

    1. Outputs within their tolerance pass; those drawn at random are not judged.
    2. Else both are compared piece by piece (:mod:`me2e_compress.manager.pieces`).
    3. Outputs that rounding alone moves as far, by inputs nudged in their last places,
       are unsteady and not judged.
    4. Else both run without onnxruntime's optimizations, some of which were wrong in
       every release; a remark says so.

    Bodies that ``after`` adds are compared with their kernels; ``passes`` are names.

    Raises:
        GraphError: ``before`` does not run; or a FramesError: the inputs do not fit.
    """
    result = _verify_outputs(passes, before, after, inputs)
    if not after.functions.keys() - before.functions.keys():
        return result
    gaps, allowed = dict(result.errors), dict(result.tolerances)
    for op_type, error, tolerance in _body_errors(before, after, inputs):
        name = f"the body of {op_type}"
        gaps[name], allowed[name] = max(gaps.get(name, 0.0), error), tolerance
    return dataclasses.replace(result, errors=gaps, tolerances=allowed)


def _verify_outputs(
    passes: tuple[str, ...],
    before: ir.Model,
    after: ir.Model,
    inputs: VerificationInputs,
) -> Verification:
    """Compare the outputs alone, by the steps of :func:`verify`."""
    # Behind a quantizer outputs differ by whole steps: begin with the pieces there
    steps = pieces.steps_after_changes(before, after)
    begin = any(step.op_type == "QuantizeLinear" for step in steps)
    result = Verification(
        passes, inputs.kind, {}, {},
        random=random_outputs(before), sizes=tuple(map(dict, inputs.sizes)),
    )  # fmt: skip
    proven, breach = None, False
    if begin:
        proven, breach = _verify_pieces(result, before, after, inputs, steps)
        if proven is not None:
            return proven
    # At the runtime's full level; a session is freed before the next one opens
    left = list(inputs.run(before))
    allowed = tolerances(left[0])
    try:
        gaps = relative_errors(left, inputs.run(after))
    except GraphError:
        gaps = dict.fromkeys(left[0], float("inf"))
    result = dataclasses.replace(result, errors=gaps, tolerances=allowed)
    if result.passed:
        return result
    # Piece by piece, then without what rounding alone moves as far
    if steps and not begin:
        proven, breach = _verify_pieces(result, before, after, inputs, steps)
        if proven is not None:
            return proven
    apart = {name: gaps[name] for name in result.judged if gaps[name] > allowed[name]}
    unsteady = unsteady_outputs(before, left, inputs, apart)
    steady = dataclasses.replace(result, unsteady=unsteady)
    if breach:
        return result if steady.passed else steady
    if steady.passed:
        return steady
    # By the nodes as they stand, where onnxruntime's rewrites are what differs
    try:
        as_written = list(inputs.run(before, optimize=False))
        plain_gaps = relative_errors(as_written, inputs.run(after, optimize=False))
    except GraphError:
        return steady
    plain = dataclasses.replace(steady, errors=plain_gaps)
    if not plain.passed:
        return steady
    rewritten = relative_errors(as_written, left)
    remarks = [
        f"onnxruntime gives another {name} of the graph"
        f" {'before' if rewritten[name] > allowed[name] else 'after'} the passes where"
        " it optimizes it: judged without its optimizations"
        for name in steady.judged
        if gaps[name] > allowed[name]
    ]
    return dataclasses.replace(plain, remarks=tuple(remarks))


def unsteady_outputs(
    model: ir.Model,
    answers: Sequence[Outputs],
    inputs: VerificationInputs,
    gaps: Mapping[str, float],
) -> tuple[str, ...]:
    """Name the outputs that move by a gap when inputs change in their last places.

    ``answers`` are what the graph gave on the inputs as they are. There are ``NUDGES``
    trials, fewer if all move; ``gaps`` are max|a-b|/max|a| by output.
    """
    session = Session(model, release=True, provider=inputs.provider)
    steady = dict(gaps)
    for seed in range(NUDGES):
        moved = relative_errors(answers, replay(session, inputs.nudged(seed).frames))
        steady = {name: gap for name, gap in steady.items() if moved[name] < gap}
        if not steady:
            break
    return tuple(name for name in gaps if name not in steady)


def _verify_pieces(
    result: Verification,
    before: ir.Model,
    after: ir.Model,
    inputs: VerificationInputs,
    steps: Sequence[pieces.Jump],
) -> tuple[Verification | None, bool]:
    """Compare the pieces between steps: return a proof, or None and whether one breaks.

    A piece breaks the promise that differs by more than rounding moves it, however far
    rounding moves the outputs after it. What rounding moves as far within its piece is
    unsteady; where every operand of a step is, nothing is proven.
    """
    operands = list(pieces.operand_names(steps).values())
    try:
        measured = pieces.piece_errors(before, after, steps, inputs)
    except (FramesError, GraphError):
        return None, False
    gaps, limits = measured.gaps, measured.limits
    apart = [name for name in measured.apart if name not in result.random]
    steady = [name for name in operands if name not in apart]
    wrong = bool({*measured.wrong} & {*apart})
    if wrong or not steady:
        return None, wrong
    worst, unsteady = max(steady, key=gaps.__getitem__), len(operands) - len(steady)
    remark = (
        "compared piece by piece, since behind a quantizer or a choice rounding"
        f" alone is a whole step: {plural(len(steady), 'operand')} of such"
        f" nodes are the same (off by {gaps[worst]:.1e} of its range at"
        f" most, {worst}; allowed {limits[worst]:.0e})"
        + f"; {unsteady} more move as far by rounding alone"
        * bool(unsteady)
    )
    proof = dataclasses.replace(
        result,
        errors={name: gap for name, gap in gaps.items() if name not in operands},
        tolerances={n: limit for n, limit in limits.items() if n not in operands},
        unsteady=tuple(name for name in apart if name not in operands),
        remarks=(remark,),
    )
    return proof, False


def difference(before: ir.Model, after: ir.Model, inputs: VerificationInputs) -> str:
    """Return the end of a message on the first module that differs; "" if none does."""
    try:
        first = find_first_difference(
            before, after, inputs.frames, inputs.provider
        ).first
    except Me2eError:
        return ""
    return "" if first is None else f"; first difference: {first}"


def unverified(passes: tuple[str, ...], why: str) -> Verification:
    """Return a verification in which nothing was measured, and why."""
    return Verification(passes, "none", {}, {}, why)


def random_outputs(model: ir.Model) -> tuple[str, ...]:
    """Name the outputs of a graph that depend on random numbers without a seed."""
    drawn = set[ir.Value]()
    for node in model.graph:
        if _draws_random(node, model) or not drawn.isdisjoint(reads_of(node)):
            drawn.update(node.outputs)
    return tuple(str(each.name) for each in model.graph.outputs if each in drawn)


def _draws_random(node: ir.Node, model: ir.Model) -> bool:
    """Return whether a node draws, or one in its bodies or its function does."""
    if draws(node):
        return "seed" not in node.attributes
    function = model.functions.get(node.op_identifier())
    bodies = bodies_of(node) if function is None else (function,)
    return any(_draws_random(each, model) for body in bodies for each in body)


def _body_errors(
    before: ir.Model, after: ir.Model, inputs: VerificationInputs
) -> Iterator[tuple[str, float, float]]:
    """Run the bodies that passes added, each on what its first call reads.

    Sessions run a fused node by its compiled kernel: the body, which a file carries for
    other runtimes, is opened alone. Yields an operator, max|a-b|/max|a| of what kernel
    and body give, which is infinite for a body that does not run, and how large that
    may be, by the dtype.

    Raises:
        GraphError: onnxruntime cannot run the graph.
    """
    added = after.functions.keys() - before.functions.keys()
    calls: dict[ir.OperatorIdentifier, ir.Node] = {}
    for node in after.graph:
        if node.op_identifier() in added:
            calls.setdefault(node.op_identifier(), node)
    if not calls:
        return
    # Without the functions every call runs as it did before: by its kernel
    bare = after.clone()
    for identifier in added:
        del bare.functions[identifier]
    made = {value.name: value for node in bare.graph for value in node.outputs}
    for node in calls.values():
        call = made[node.outputs[0].name].producer()
        assert call is not None
        for place, value in enumerate(call.inputs):
            if value is not None:
                pieces.add_output(bare, value, _probe_name(node, place))
        pieces.add_output(bare, call.outputs[0], _probe_name(node, None))
    first = dataclasses.replace(inputs, frames=inputs.frames[:1])
    (values,) = first.run(bare)
    for identifier, node in calls.items():
        body = _one_call_model(node, after.functions[identifier], after)
        reads = {
            str(value.name): values[_probe_name(node, place)]
            for place, value in enumerate(node.inputs)
            if value is not None
        }
        by_kernel = values[_probe_name(node, None)]
        try:
            error = relative_error(by_kernel, run_once(body, reads)["answer"])
        except (FramesError, GraphError):
            error = math.inf
        yield node.op_type, error, TOLERANCES.get(by_kernel.dtype.name, 0.0)


def _probe_name(node: ir.Node, place: int | None) -> str:
    return f"call/{node.outputs[0].name}/{'answer' if place is None else place}"


def _one_call_model(node: ir.Node, function: ir.Function, model: ir.Model) -> ir.Model:
    """Return a graph of one call, which runs its body instead of a kernel."""
    reads = [
        value and ir.Value(name=value.name, type=value.type, shape=value.shape)
        for value in node.inputs
    ]
    function = function.clone()
    function.domain = _BODY
    attributes = list(node.attributes.values())
    call = ir.Node(
        _BODY, node.op_type, reads, attributes, overload=node.overload, name="call"
    )
    call.outputs[0].name, call.outputs[0].type = "answer", node.outputs[0].type
    body = ir.Graph(
        list({value.name: value for value in reads if value is not None}.values()),
        call.outputs,
        nodes=[call],
        opset_imports={**model.opset_imports, _BODY: 1},
    )
    return ir.Model(body, ir_version=model.ir_version, functions=[function])
