"""The use of each output of a graph, whether or not the model could drive."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from me2e_compress.driving.adapter.adapter import Adapter
from me2e_compress.driving.adapter.controls import ControlAdapter, output_named
from me2e_compress.driving.adapter.outputs import ModelOutputs
from me2e_compress.driving.adapter.port_use import PortUse, element_type
from me2e_compress.driving.ports import Shape
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.plan_adapter import CONTRACT_STEP_S, PlanAdapter


@dataclass(frozen=True)
class OutputUses:
    """Which outputs drive, and how they are read.

    ``drives_by`` names the plan, the controls or both in words, and is empty if there
    is none; ``uses`` is by output; ``problems`` are names that do not exist.
    """

    drives_by: str
    uses: Mapping[str, str]
    problems: tuple[str, ...]

    @classmethod
    def of(cls, session: AnySession, adapter: Adapter) -> Self:
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
        if found.fusion is not None:
            return cls(f"both, fused ({found.fusion.options.rule})", uses, ())
        return cls("its plan" if found.control is None else "its controls", uses, ())

    def ports(
        self, session: AnySession, recurrent: Mapping[str, str]
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
