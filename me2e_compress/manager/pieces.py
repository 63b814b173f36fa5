"""Compare two graphs piece by piece, between the operators whose answer jumps.

After a quantizer a difference of 1e-7 is a whole step of int8, and after a TopK another
candidate: two graphs that are equal but for rounding differ there, on one machine and
not on another, although no node is wrong. They are equal if every piece between such
operators is. So the second graph reads what those answer in the first one, and the
operands that it computes for each are compared, with its outputs, within the
tolerances of outputs.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.graph.nodes import (
    FLOATS,
    array_of,
    has_subgraph,
    holds_numbers,
    is_standard,
    reads_of,
)
from me2e_compress.graph.provenance import is_same
from me2e_compress.graph.rewrite import sweep
from me2e_compress.manager.verification_inputs import (
    NUDGES,
    Outputs,
    VerificationInputs,
    nudge,
    relative_error,
    tensors_of,
    tolerances,
)
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session

STEPS = frozenset(
    {
        "ArgMax", "ArgMin", "Ceil", "DynamicQuantizeLinear", "Equal", "Floor",
        "Greater", "GreaterOrEqual", "Hardmax", "Less", "LessOrEqual", "Mod",
        "NonMaxSuppression", "QuantizeLinear", "Round", "Sigmoid", "Sign", "TopK",
    }
)  # fmt: skip
"""Operators of ONNX whose answer jumps where what they read moves; a Cast to whole
numbers and a GridSample of nearest pixels do, too."""

_OPERAND, _ANSWER = "piece/operand", "piece/answer"


@dataclasses.dataclass(frozen=True)
class Jump:
    """A step that both graphs have, by the names of its outputs.

    ``operands`` are the places of those inputs that are not one constant in both.
    """

    op_type: str
    outputs: tuple[str, ...]
    operands: tuple[int, ...]


Errors: TypeAlias = dict[str, float]
"""max|a-b|/max|a| by output, and by operand of a step (`operand_names`)."""


def operand_names(steps: Sequence[Jump]) -> dict[str, str]:
    """Map the outputs that hold operands of steps to their names in messages."""
    return {
        _step_name(_OPERAND, index, place): f"operand {place} of {step.outputs[0]}"
        for index, step in enumerate(steps)
        for place in step.operands
    }


@dataclasses.dataclass(frozen=True)
class PieceErrors:
    """How far two graphs are apart, over all frames, by output and by operand.

    Attributes:
        gaps: of the second graph.
        limits: what is allowed, by dtype.
        rounding: what the first graph gives for inputs and weights that were changed
            in their last places; only where a gap was beyond its limit.
    """

    gaps: Errors
    limits: Errors
    rounding: Errors

    @property
    def apart(self) -> list[str]:
        """What differs by more than its limit."""
        return [name for name, gap in self.gaps.items() if gap > self.limits[name]]

    @property
    def wrong(self) -> list[str]:
        """What differs by more than rounding moves it, too."""
        return [n for n in self.apart if self.gaps[n] > self.rounding.get(n, 0.0)]


def piece_errors(
    before: ir.Model, after: ir.Model, steps: Sequence[Jump], inputs: VerificationInputs
) -> PieceErrors:
    """Run a graph, and another on what its steps gave; nodes run as they stand.

    Recurrent state, too, is that of the first. Each frame runs once through each graph,
    and up to `NUDGES` times through the first one nudged, if something is apart.

    Raises:
        GraphError: onnxruntime cannot run one.
    """
    open_session = functools.partial(
        Session, optimize=False, release=True, provider=inputs.provider
    )
    first, second = (
        open_session(model)
        for model in (_expose(before, steps), _substitute(after, steps))
    )
    errors = PieceErrors({}, {}, {})
    nudged: dict[int, tuple[Session, Sequence[Frame]]] = {}
    state: Mapping[str, Array] = {}
    for place, frame in enumerate(inputs.frames):
        # What the first graph makes of the frame
        if frame.starts_scene:
            state = first.first_state(frame.arrays)
        left = tensors_of(first.run({**frame.arrays, **state}))
        fixed = {**state, **{k: v for k, v in left.items() if k in second.inputs}}
        # What the second does, and what rounding alone does
        right = second.run({**frame.arrays, **fixed})
        _add_errors(errors.gaps, left, right, steps)
        allowed = zip(_called(right, steps), tolerances(right).values(), strict=True)
        errors.limits.update(allowed)
        for seed in range(NUDGES):
            if not errors.wrong:
                break
            if seed not in nudged:
                moved = _substitute(nudged_weights(before, seed), steps)
                nudged[seed] = open_session(moved), inputs.nudged(seed).frames
            session, frames = nudged[seed]
            right = session.run({**frames[place].arrays, **fixed})
            _add_errors(errors.rounding, left, right, steps)
        state = {name: left[answer] for name, answer in first.recurrent.items()}
    return errors


def _called(outputs: Outputs, steps: Sequence[Jump]) -> list[str]:
    """Return what messages call each output of a graph with operands of steps."""
    return list(map(operand_names(steps).get, outputs, outputs))


def _add_errors(
    errors: Errors, left: Outputs, right: Outputs, steps: Sequence[Jump]
) -> None:
    """Raise errors to those of a frame: max|a-b|/max|a| of what ``right`` holds."""
    for (name, value), called in zip(right.items(), _called(right, steps), strict=True):
        errors[called] = max(errors.get(called, 0.0), relative_error(left[name], value))


def nudged_weights(model: ir.Model, seed: int) -> ir.Model:
    """Return a copy whose float weights are moved by a few units in the last place."""
    copy, signs = model.clone(), np.random.default_rng(seed)
    for value in copy.graph.initializers.values():
        if holds_numbers(value) and value.const_value is not None:
            moved = nudge(value.const_value.numpy(), signs)
            value.const_value = ir.tensor(moved, name=value.name)
    return copy


def steps_after_changes(before: ir.Model, after: ir.Model) -> tuple[Jump, ...]:
    """Return the first steps of both graphs that read what a pass changed.

    After a step nothing counts as changed, until another node is.
    """
    makers = {value.name: node for node in before.graph for value in node.outputs}
    changed, steps = set[ir.Value](), list[Jump]()
    for node in after.graph:
        twin = makers.get(node.outputs[0].name) if node.outputs else None
        moved = not changed.isdisjoint(reads_of(node))
        alike = twin is not None and _is_twin(twin, node, before, after)
        if twin is not None and alike and is_step(node) and is_step(twin):
            operands = _operands(twin, node)
            if operands is not None:
                if moved or _reads_differ(twin, node):
                    outputs = tuple(str(v.name) for v in node.outputs if v.name)
                    steps.append(Jump(node.op_type, outputs, operands))
                continue
        if moved or twin is None or not alike or _reads_differ(twin, node):
            changed.update(node.outputs)
    return tuple(steps)


def is_step(node: ir.Node) -> bool:
    """Return whether the answer of a node jumps where what it reads moves."""
    if not is_standard(node):
        return False
    if node.op_type == "Cast":
        kinds = node.inputs[0].dtype if node.inputs[0] else None, node.outputs[0].dtype
        return kinds[0] in FLOATS and kinds[1] is not None and kinds[1] not in FLOATS
    if node.op_type == "GridSample":
        return node.attributes.get_string("mode", "linear") == "nearest"
    return node.op_type in STEPS


def _is_twin(twin: ir.Node, node: ir.Node, before: ir.Model, after: ir.Model) -> bool:
    """Return whether two nodes compute the same outputs of equal inputs."""
    if has_subgraph(node) or len(twin.inputs) != len(node.inputs):
        return False
    if node.op_identifier() in (*before.functions, *after.functions):
        return False  # a body may be another
    names = [value.name for value in node.outputs]
    return is_same(twin, node) and names == [value.name for value in twin.outputs]


def _reads_differ(twin: ir.Node, node: ir.Node) -> bool:
    """Return whether one of two nodes reads another value, or another constant."""
    return not all(map(_is_same_value, twin.inputs, node.inputs))


def _is_same_value(mine: ir.Value | None, theirs: ir.Value | None) -> bool:
    if mine is None or theirs is None:
        return mine is theirs
    shared = mine.const_value is theirs.const_value  # None where a node makes them
    return mine.name == theirs.name and (shared or _is_one_constant(mine, theirs))


def _is_one_constant(mine: ir.Value, theirs: ir.Value) -> bool:
    a, b = array_of(mine), array_of(theirs)
    if a is None or b is None or a.dtype != b.dtype:
        return False
    return np.array_equal(a, b)


def _operands(twin: ir.Node, node: ir.Node) -> tuple[int, ...] | None:
    """Return the indices of the operands to compare; None if constants differ."""
    places = []
    for place, (mine, theirs) in enumerate(zip(twin.inputs, node.inputs, strict=True)):
        if mine is None or theirs is None:
            if mine is not theirs:
                return None
        elif array_of(mine) is None or array_of(theirs) is None:
            places.append(place)
        elif not _is_one_constant(mine, theirs):
            return None
    return tuple(places)


def _expose(
    model: ir.Model, steps: Sequence[Jump], *, answers: bool = True
) -> ir.Model:
    """Return a copy whose outputs include each step's operands and answers."""
    copy = model.clone()
    values = {value.name: value for node in copy.graph for value in node.outputs}
    for index, step in enumerate(steps):
        node = values[step.outputs[0]].producer()
        assert node is not None
        for place in step.operands:
            add_output(copy, node.inputs[place], _step_name(_OPERAND, index, place))
        for place, name in enumerate(step.outputs if answers else ()):
            add_output(copy, values[name], _step_name(_ANSWER, index, place))
    return copy


def _substitute(model: ir.Model, steps: Sequence[Jump]) -> ir.Model:
    """Return a copy with outputs for each step's operands, inputs for its answers."""
    copy = _expose(model, steps, answers=False)
    values = {value.name: value for node in copy.graph for value in node.outputs}
    for index, step in enumerate(steps):
        for place, name in enumerate(step.outputs):
            _replace_by_input(copy, values[name], _step_name(_ANSWER, index, place))
    sweep(copy)
    return copy


def _step_name(kind: str, index: int, place: int) -> str:
    return f"{kind}/{index}/{place}"


def add_output(model: ir.Model, value: ir.Value | None, name: str) -> None:
    """Add a copy of a value to the graph's outputs, under another name."""
    assert value is not None
    node = ir.node("Identity", [value])
    node.outputs[0].name = node.name = name
    node.outputs[0].type, node.outputs[0].shape = value.type, value.shape
    model.graph.append(node)
    model.graph.outputs.append(node.outputs[0])


def _replace_by_input(model: ir.Model, value: ir.Value, name: str) -> None:
    """Replace a value by a new input; where it is an output, that keeps its name."""
    given = ir.Value(name=name, type=value.type, shape=value.shape)
    model.graph.inputs.append(given)
    known = str(value.name)
    for place, output in enumerate(model.graph.outputs):
        if output is value:
            value.name = f"{name}/unread"
            alias = ir.node("Identity", [given])
            alias.outputs[0].name = known
            alias.outputs[0].type, alias.outputs[0].shape = value.type, value.shape
            model.graph.append(alias)
            model.graph.outputs[place] = alias.outputs[0]
    value.replace_all_uses_with(given)
