"""The use of each input and output of a graph, whether or not it could drive."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from me2e_compress.driving.adapter.adapter import (
    Adapter,
    ControlAdapter,
    Feed,
    output_named,
)
from me2e_compress.driving.adapter.image_inputs import ImageInput
from me2e_compress.driving.adapter.inputs import ModelInputs
from me2e_compress.driving.adapter.outputs import ModelOutputs
from me2e_compress.driving.adapter.recurrent import ZEROS
from me2e_compress.driving.contract import Shape, zeros
from me2e_compress.driving.input_sources import INPUT_SOURCES
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.runtime.plan_adapter import CONTRACT_STEP_S, PlanAdapter
from me2e_compress.runtime.session import DTYPES, Session, SessionPort


@dataclass(frozen=True)
class PortUse:
    """One input or output of a graph, and its part in driving.

    ``use`` is an input's feed or how an output is read, None for nothing; ``problem``
    says why the model cannot drive so, and is empty where it can.
    """

    name: str
    shape: Shape
    type: str
    use: str | None
    problem: str = ""


def element_type(of_port: str) -> str:
    """Return ``int64`` of ``tensor(int64)``."""
    return of_port.removeprefix("tensor(").removesuffix(")")


def input_uses(
    session: Session, adapter: Adapter, recurrent: Mapping[str, str]
) -> tuple[PortUse, ...]:
    """List the inputs of a graph, in its order, with what each is fed."""
    found, problems = ModelInputs.found(session, adapter, recurrent)
    # each input's feed in words
    words = {
        name: f"{answer} of the frame before" for name, answer in recurrent.items()
    }
    words |= {name: image_words(table) for name, table in found.tables.items()}
    words |= {name: feed_words(feed) for name, feed in found.given.items()}
    # faults of types and first values
    for name, port in session.inputs.items():
        if port.type not in DTYPES:
            problems[name] = f"input {name} is {port.type}: it cannot be fed"
        elif name in recurrent:
            entry = (adapter.recurrent or {}).get(name)
            if entry is None or entry.first == ZEROS:
                problems |= _no_start(name, port)
    return tuple(
        PortUse(
            name,
            port.shape,
            element_type(port.type),
            words.get(name),
            problems.get(name, ""),
        )
        for name, port in session.inputs.items()
    )


def image_words(table: ImageInput) -> str:
    """Tell which cameras an image shows."""
    count = len(table.cameras)
    words = "the six cameras" if count == 6 else ", ".join(table.cameras)
    return f"{words}, side by side" if table.stitch else words


def feed_words(feed: Feed) -> str:
    """Tell what an input is made of, with the options that were chosen."""
    return ", ".join(INPUT_SOURCES.text(part.source) for part in feed.parts)


def _no_start(name: str, port: SessionPort) -> dict[str, str]:
    try:
        zeros(name, port)
    except EvaluationError as error:
        return {name: str(error)}
    return {}


@dataclass(frozen=True)
class OutputUses:
    """Which outputs drive, and how they are read.

    ``drives_by`` names the plan or the controls in words, and is empty if there
    is none; ``uses`` is by output; ``problems`` are names that do not exist.
    """

    drives_by: str
    uses: Mapping[str, str]
    problems: tuple[str, ...]

    @classmethod
    def of(cls, session: Session, adapter: Adapter) -> Self:
        """Find the uses of a graph's outputs."""
        try:
            found = ModelOutputs.of(session, adapter)
        except (EvaluationError, GraphError) as error:
            return cls("", {}, (str(error),))
        uses: dict[str, str] = {}
        if found.plan is not None:
            output = found.plan.output
            uses[output] = plan_words(found.plan, session.outputs[output].shape)
            if found.plan.scores is not None:
                uses[found.plan.scores] = "scores, which pick the plan's mode"
        if found.control is not None:
            uses |= control_words(found.control, session.outputs)
        return cls("its plan" if found.control is None else "its controls", uses, ())

    def ports(
        self, session: Session, recurrent: Mapping[str, str]
    ) -> tuple[PortUse, ...]:
        """List the outputs of the graph, in its order."""
        back = {answer: f"fed back to {name}" for name, answer in recurrent.items()}
        return tuple(
            PortUse(name, port.shape, element_type(port.type), _both(name, self, back))
            for name, port in session.outputs.items()
        )


def plan_words(plan: PlanAdapter, shape: Shape) -> str:
    """Tell how a plan is read: how many waypoints, how far apart, by which mode."""
    sides = plan.shape or shape
    count = sides[-2] if len(sides) > 1 else None
    step_s = CONTRACT_STEP_S if plan.step_s is None else plan.step_s
    many = f"{count} waypoints" if isinstance(count, int) else "waypoints"
    words = f"plan: {many} {step_s:g} s apart"
    if plan.deltas:
        words += ", as steps"
    # how the mode is picked, if there are several
    if plan.command_input is not None:
        words += f", mode by {plan.command_input}"
    elif plan.default_mode is not None and len(sides) > (
        3 if plan.shape is None else 2
    ):
        words += f", mode {plan.default_mode}"
    return words


def control_words(
    control: ControlAdapter, outputs: Mapping[str, object]
) -> dict[str, str]:
    """Tell what is read of each output as a control."""
    found: dict[str, list[str]] = {}
    for text, what in control.outputs.items():
        found.setdefault(output_named(text, outputs)[0], []).append(what)
    return {name: "control: " + ", ".join(each) for name, each in found.items()}


def _both(name: str, used: OutputUses, back: Mapping[str, str]) -> str | None:
    words = [each[name] for each in (used.uses, back) if name in each]
    return "; ".join(words) or None
