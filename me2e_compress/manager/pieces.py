"""Compare two graphs piece by piece, between the operators whose answer jumps.

Behind a quantizer a difference of 1e-7 is a whole step of int8, and behind a TopK
another candidate: two graphs that are equal but for rounding part there, on one machine
and not on another, although no node is wrong. They are equal if every piece between
such operators is. So the second graph gets what those gave in the first one, and what
it computes in front of each is compared, with its outputs, at the tolerances that
outputs have.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Self

import numpy as np
import onnx_ir as ir

from me2e_compress.display import counted
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
from me2e_compress.manager.output_errors import TOLERANCES, relative
from me2e_compress.manager.verification_inputs import VerificationInputs, nudge
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session

STEPS = frozenset(
    {
        "ArgMax", "ArgMin", "Ceil", "DynamicQuantizeLinear", "Equal", "Floor",
        "Greater", "GreaterOrEqual", "Hardmax", "Less", "LessOrEqual", "Mod",
        "NonMaxSuppression", "QuantizeLinear", "Round", "Sign", "TopK",
    }
)  # fmt: skip
"""Operators of ONNX whose answer jumps where what they read moves; a Cast to whole
numbers and a GridSample of nearest pixels do, too."""

_OPERAND, _ANSWER = "piece/operand", "piece/answer"


@dataclasses.dataclass(frozen=True)
class PieceErrors:
    """How far two graphs are apart between their steps, over all frames.

    Attributes:
        outputs: max|a-b|/max|a| by output.
        operands: the same of what steps read, by operand and first output of the step.
        tolerances: how large those may be, by their dtypes.
    """

    outputs: dict[str, float]
    operands: dict[str, float]
    tolerances: dict[str, float]

    def worst(self, other: Self) -> Self:
        """Return the larger errors of the two."""
        return type(self)(
            _larger(self.outputs, other.outputs),
            _larger(self.operands, other.operands),
            other.tolerances,
        )

    @property
    def remark(self) -> str:
        """What was compared, and the operand that is farthest off."""
        worst = max(self.operands, key=lambda name: self.operands[name])
        return (
            "compared piece by piece, since behind a quantizer or a choice rounding"
            f" alone is a whole step: {counted(len(self.operands), 'operand')} of such"
            f" nodes are the same (off by {self.operands[worst]:.1e} of its range at"
            f" most, {worst}; allowed {self.tolerances[worst]:.0e})"
        )


@dataclasses.dataclass(frozen=True)
class _Step:
    """A step that both graphs have, by the names of its outputs.

    ``operands`` are the places of those inputs that are not one constant in both.
    """

    outputs: tuple[str, ...]
    operands: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Pieces:
    """A graph, another one, and the steps behind what differs in them.

    Both run their nodes as they stand, one frame after the other; recurrent state, too,
    is that of the first. Methods raise GraphError where onnxruntime cannot run one.
    """

    before: ir.Model
    after: ir.Model
    steps: tuple[_Step, ...]

    @classmethod
    def of(cls, before: ir.Model, after: ir.Model) -> Self | None:
        """Return the pieces of two graphs; None where no step is behind a change."""
        steps = steps_behind_changes(before, after)
        return cls(before, after, steps) if steps else None

    def errors(self, inputs: VerificationInputs) -> PieceErrors:
        """Compare what the second graph computes with what the first does."""
        (errors,) = self._errors(inputs, [(self.after, inputs)])
        return errors

    def rounding(self, inputs: VerificationInputs, trials: int) -> PieceErrors:
        """Measure how far rounding alone moves each piece: the largest of some trials.

        Inputs and weights of the first graph are changed in their last places.
        """
        moved = [(_nudged(self.before, t), inputs.nudged(t)) for t in range(trials)]
        return functools.reduce(PieceErrors.worst, self._errors(inputs, moved))

    def _errors(
        self,
        inputs: VerificationInputs,
        others: Sequence[tuple[ir.Model, VerificationInputs]],
    ) -> list[PieceErrors]:
        """Run the first graph once, and others on what its steps gave."""
        results = [PieceErrors({}, {}, {}) for _ in others]
        provider, steps = inputs.provider, self.steps
        sessions = [
            Session(
                _continued(model, steps),
                optimize="none", release=True, provider=provider,
            )
            for model, _ in others
        ]  # fmt: skip
        state: Mapping[str, Array] = {}
        runs = inputs.run(_observed(self.before, steps), "none")
        for index, left in enumerate(runs):
            for place, (_, own) in enumerate(others):
                session = sessions[place]
                right = session.run(_feeds(own.frames[index], state, left, session))
                results[place] = results[place].worst(self._frame_errors(left, right))
            recurrent = sessions[0].recurrent.items()
            state = {name: left[answer] for name, answer in recurrent}
        return results

    def _frame_errors(
        self, left: Mapping[str, Array], right: Mapping[str, Array]
    ) -> PieceErrors:
        steps = {
            _name(_OPERAND, index, place): f"operand {place} of {step.outputs[0]}"
            for index, step in enumerate(self.steps)
            for place in step.operands
        }
        errors = {name: relative(left[name], value) for name, value in right.items()}
        limits = {name: TOLERANCES.get(right[name].dtype.name, 0.0) for name in steps}
        return PieceErrors(
            {name: error for name, error in errors.items() if name not in steps},
            {steps[name]: errors[name] for name in steps},
            {steps[name]: limit for name, limit in limits.items()},
        )


def _larger(one: Mapping[str, float], other: Mapping[str, float]) -> dict[str, float]:
    return {name: max(one.get(name, 0.0), error) for name, error in other.items()}


def _nudged(model: ir.Model, seed: int) -> ir.Model:
    """Return a copy whose float weights are moved by a few units in the last place."""
    copy, signs = model.clone(), np.random.default_rng(seed)
    for value in copy.graph.initializers.values():
        if holds_numbers(value) and value.const_value is not None:
            moved = nudge(value.const_value.numpy(), signs)
            value.const_value = ir.tensor(moved, name=value.name)
    return copy


def _feeds(
    frame: Frame,
    state: Mapping[str, Array],
    left: Mapping[str, Array],
    session: Session,
) -> dict[str, Array]:
    """Return what another graph reads: a frame, state and answers of the first."""
    if frame.starts_scene:
        state = session.first_state(frame.arrays)
    answers = {name: value for name, value in left.items() if name in session.inputs}
    return {**frame.arrays, **state, **answers}


def steps_behind_changes(before: ir.Model, after: ir.Model) -> tuple[_Step, ...]:
    """Find the steps of both graphs that read what a pass changed, first ones alone.

    Behind a step nothing counts as changed, until another node is.
    """
    makers = {value.name: node for node in before.graph for value in node.outputs}
    changed, steps = set[ir.Value](), list[_Step]()
    for node in after.graph:
        twin = makers.get(node.outputs[0].name) if node.outputs else None
        moved = not changed.isdisjoint(reads_of(node))
        alike = twin is not None and _is_alike(twin, node, before, after)
        if twin is not None and alike and is_step(node) and is_step(twin):
            operands = _operands(twin, node)
            if operands is not None:
                if moved or _reads_others(twin, node):
                    outputs = tuple(str(v.name) for v in node.outputs if v.name)
                    steps.append(_Step(outputs, operands))
                continue
        if moved or twin is None or not alike or _reads_others(twin, node):
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


def _is_alike(twin: ir.Node, node: ir.Node, before: ir.Model, after: ir.Model) -> bool:
    """Return whether two nodes compute the same of equal inputs, and give as much."""
    if has_subgraph(node) or len(twin.inputs) != len(node.inputs):
        return False
    if node.op_identifier() in (*before.functions, *after.functions):
        return False  # a body may be another
    names = [value.name for value in node.outputs]
    return is_same(twin, node) and names == [value.name for value in twin.outputs]


def _reads_others(twin: ir.Node, node: ir.Node) -> bool:
    """Return whether one of two nodes reads another value, or another constant."""
    return any(
        (mine is None) != (theirs is None)
        or (mine is not None and theirs is not None and not _is_one(mine, theirs))
        for mine, theirs in zip(twin.inputs, node.inputs, strict=True)
    )


def _is_one(mine: ir.Value, theirs: ir.Value) -> bool:
    if mine.name != theirs.name or mine.is_initializer() != theirs.is_initializer():
        return False
    return mine.const_value is theirs.const_value or _is_one_constant(mine, theirs)


def _is_one_constant(mine: ir.Value, theirs: ir.Value) -> bool:
    a, b = array_of(mine), array_of(theirs)
    if a is None or b is None or a.dtype != b.dtype:
        return False
    return np.array_equal(a, b)


def _operands(twin: ir.Node, node: ir.Node) -> tuple[int, ...] | None:
    """Return the places of the operands to compare; None if constants differ."""
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


def _observed(model: ir.Model, steps: tuple[_Step, ...]) -> ir.Model:
    """Return a copy that also gives what each step reads, and what it gives."""
    copy = model.clone()
    values = {value.name: value for node in copy.graph for value in node.outputs}
    for index, step in enumerate(steps):
        node = values[step.outputs[0]].producer()
        assert node is not None
        for place in step.operands:
            show(copy, node.inputs[place], _name(_OPERAND, index, place))
        for place, name in enumerate(step.outputs):
            show(copy, values[name], _name(_ANSWER, index, place))
    return copy


def _continued(model: ir.Model, steps: tuple[_Step, ...]) -> ir.Model:
    """Return a copy that gives what each step reads, and is fed what each gives."""
    copy = model.clone()
    values = {value.name: value for node in copy.graph for value in node.outputs}
    for index, step in enumerate(steps):
        node = values[step.outputs[0]].producer()
        assert node is not None
        for place in step.operands:
            show(copy, node.inputs[place], _name(_OPERAND, index, place))
    for index, step in enumerate(steps):
        for place, name in enumerate(step.outputs):
            _feed(copy, values[name], _name(_ANSWER, index, place))
    sweep(copy)
    return copy


def _name(kind: str, index: int, place: int) -> str:
    return f"{kind}/{index}/{place}"


def show(model: ir.Model, value: ir.Value | None, name: str) -> None:
    """Give a value of the graph as an output of another name."""
    assert value is not None
    node = ir.node("Identity", [value])
    node.outputs[0].name = node.name = name
    node.outputs[0].type, node.outputs[0].shape = value.type, value.shape
    model.graph.append(node)
    model.graph.outputs.append(node.outputs[0])


def _feed(model: ir.Model, value: ir.Value, name: str) -> None:
    """Let an input of a name stand for a value; an output keeps its own name."""
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
