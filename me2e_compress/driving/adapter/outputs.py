"""Convert a graph's outputs to a policy's answer."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from me2e_compress.driving.adapter.adapter import Adapter
from me2e_compress.driving.adapter.controls import ControlAdapter, output_named
from me2e_compress.driving.contract import Answer, Observation, Trajectory
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.plan_adapter import PlanAdapter
from me2e_compress.runtime.session import Session

COMMAND = "command"
"""Name of the navigator's command among the inputs."""


@dataclass(frozen=True)
class ModelOutputs:
    """How a graph's outputs are read at each decision, without recurrent ones.

    ``plan`` is None if the controls drive, ``control`` if the plan drives.
    """

    adapter: Adapter
    plan: PlanAdapter | None
    control: ControlAdapter | None

    @classmethod
    def of(cls, session: Session, adapter: Adapter) -> Self:
        """Find the outputs of a graph to read."""
        outputs, control = list(session.outputs), adapter.control
        if control is not None:
            check_control(control, outputs)
            return cls(adapter, None, control)
        plan = plan_of(adapter.plan, session.metadata, outputs)
        check_command(plan, session.inputs)
        return cls(adapter, plan, None)

    def trajectory(
        self,
        outputs: Mapping[str, Array],
        feeds: Mapping[str, Array],
        observation: Observation,
    ) -> Trajectory | None:
        """Return the plan in the ego frame; None where controls drive."""
        if self.plan is None:
            return None
        command = np.array([observation.command])
        points = self.plan.plan(outputs, {**feeds, COMMAND: command})
        return self.plan.trajectory(self.adapter.to_ego(points))

    def answer(self, plan: Trajectory | None, outputs: Mapping[str, Array]) -> Answer:
        """Return the plan (as the host stage left it), or the controls."""
        if self.control is not None:
            return self.control.read(outputs)
        assert plan is not None
        return plan


def check_control(control: ControlAdapter, outputs: Sequence[str]) -> None:
    """Check that a graph has the outputs that are read as controls."""
    there = dict.fromkeys(outputs)
    for text, what in control.outputs.items():
        name, _ = output_named(text, there)
        if name not in there:
            raise EvaluationError(
                f"no output {name}, which the adapter names as {what}; there are "
                f"{', '.join(outputs)}"
            )


def check_command(plan: PlanAdapter, inputs: Collection[str]) -> None:
    """Check that the input that picks the plan's mode exists, or is the command."""
    if plan.command_input not in (None, COMMAND, *inputs):
        raise EvaluationError(
            f"no input {plan.command_input}, which picks the plan's mode"
            f" (command_input); there are {COMMAND}, the navigator's, and"
            f" {', '.join(inputs)}"
        )


def plan_of(
    adapted: PlanAdapter | None, metadata: Mapping[str, str], outputs: Sequence[str]
) -> PlanAdapter:
    """Return the adapter's reading of the plan, or else the metadata's."""
    # the plan and the scores that pick its mode must be outputs
    found = adapted or PlanAdapter.of(metadata, outputs)
    there = ", ".join(outputs)
    if found is None:
        raise EvaluationError(
            f"the model has no output plan, and no adapter or metadata names one; "
            f"there are {there}"
        )
    if found.output not in outputs:
        raise EvaluationError(
            f"no output {found.output}, which is named as the plan; there are {there}"
        )
    if found.scores is not None and found.scores not in outputs:
        raise EvaluationError(
            f"no output {found.scores}, which is named as the scores; there are {there}"
        )
    return found
