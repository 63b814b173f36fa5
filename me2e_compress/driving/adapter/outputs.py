"""What a graph's outputs say, as a policy's answer."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from me2e_compress.driving.adapter.adapter import Adapter
from me2e_compress.driving.adapter.controls import ControlAdapter, output_named
from me2e_compress.driving.contract import Answer, Observation, Trajectory
from me2e_compress.driving.head_fusion import HeadFusion
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.plan_adapter import PlanAdapter

COMMAND = "command"
"""What the navigator's command is called beside the inputs."""


@dataclass(frozen=True)
class ModelOutputs:
    """How a graph is read at each decision, recurrent outputs left out.

    Attributes:
        adapter: How its outputs relate to the contract.
        plan: How its plan is read; None where controls alone drive.
        control: How its controls are read; None where the plan alone drives.
        fusion: Fuses both, and remembers; None where one drives.
    """

    adapter: Adapter
    plan: PlanAdapter | None
    control: ControlAdapter | None
    fusion: HeadFusion | None

    @classmethod
    def of(cls, session: AnySession, adapter: Adapter) -> Self:
        """Find what is read of a graph's outputs.

        Raises:
            EvaluationError: Nothing names the plan or the controls, or the graph has no
                such output.
        """
        outputs, control = list(session.outputs), adapter.control
        fusion = None if adapter.fusion is None else HeadFusion(adapter.fusion)
        if control is not None:
            check_control(control, outputs)
            if fusion is None:
                return cls(adapter, None, control, None)
        plan = plan_of(adapter.plan, session.metadata, outputs)
        check_command(plan, session.inputs)
        return cls(adapter, plan, control, fusion)

    def reset(self) -> None:
        """Begin a route."""
        if self.fusion is not None:
            self.fusion.reset()

    def trajectory(
        self,
        outputs: Mapping[str, Array],
        feeds: Mapping[str, Array],
        observation: Observation,
    ) -> Trajectory | None:
        """Return the plan in the ego frame; None where controls alone drive.

        Args:
            outputs: Of the graph.
            feeds: What it was fed.
            observation: What that was made of.

        Raises:
            GraphError: See `PlanAdapter.plan`.
        """
        if self.plan is None:
            return None
        command = np.array([observation.command])
        points = self.plan.plan(outputs, {**feeds, COMMAND: command})
        return self.plan.trajectory(self.adapter.to_ego(points))

    def answer(
        self,
        plan: Trajectory | None,
        outputs: Mapping[str, Array],
        observation: Observation,
    ) -> Answer:
        """Return what drives: the plan, the controls, or both fused.

        Args:
            plan: From :meth:`trajectory`, as the host left it.
            outputs: Of the graph.
            observation: What the graph was fed is made of.

        Raises:
            EvaluationError: An output has not as many numbers, or fusion lacks the
                target point.
        """
        if self.control is None:
            assert plan is not None
            return plan
        control = self.control.read(outputs)
        if self.fusion is None or plan is None:
            return control
        speed_mps, points = observation.speed_mps, observation.target_points
        if points is None:
            raise EvaluationError("fusion aims at a target point, and there is none")
        forward, left = points[0].tolist()
        return self.fusion.fuse(plan, control, speed_mps, (-left, forward))


def check_control(control: ControlAdapter, outputs: Sequence[str]) -> None:
    """Check that a graph has the outputs that are read as controls.

    Raises:
        EvaluationError: One is not there.
    """
    there = dict.fromkeys(outputs)
    for text, what in control.outputs.items():
        name, _ = output_named(text, there)
        if name not in there:
            raise EvaluationError(
                f"no output {name}, which the adapter names as {what}; there are "
                f"{', '.join(outputs)}"
            )


def check_command(plan: PlanAdapter, inputs: Collection[str]) -> None:
    """Check that what picks the plan's mode is there: an input, or the command.

    Raises:
        EvaluationError: It is not.
    """
    if plan.command_input not in (None, COMMAND, *inputs):
        raise EvaluationError(
            f"no input {plan.command_input}, which picks the plan's mode"
            f" (command_input); there are {COMMAND}, the navigator's, and"
            f" {', '.join(inputs)}"
        )


def plan_of(
    adapted: PlanAdapter | None, metadata: Mapping[str, str], outputs: Sequence[str]
) -> PlanAdapter:
    """Return the adapter's reading of the plan, or else the model's own.

    Args:
        adapted: What the adapter says of it.
        metadata: Of the model.
        outputs: Of the model, by name.

    Raises:
        EvaluationError: Nothing names the plan, or the model has no such output.
    """
    found = adapted or PlanAdapter.of(metadata, outputs)
    there = ", ".join(outputs)
    if found is None:
        raise EvaluationError(
            f"the model has no output plan, and no adapter or metadata names one; "
            f"there are {there}"
        )
    if found.output not in outputs:
        raise EvaluationError(
            f"no output {found.output}, which the adapter names as the plan; there "
            f"are {there}"
        )
    if found.scores is not None and found.scores not in outputs:
        raise EvaluationError(
            f"no output {found.scores}, which the adapter names as the scores; "
            f"there are {there}"
        )
    return found
