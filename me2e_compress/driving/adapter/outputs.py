"""What a graph's outputs say, as a policy's answer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from me2e_compress.driving.adapter.adapter import Adapter
from me2e_compress.driving.contract import Observation, Trajectory
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.plan_adapter import PlanAdapter


@dataclass(frozen=True)
class ModelOutputs:
    """How a graph is read at each decision, recurrent outputs left out.

    Attributes:
        adapter: How its outputs relate to the contract.
        plan: How its plan is read.
    """

    adapter: Adapter
    plan: PlanAdapter

    @classmethod
    def of(cls, session: AnySession, adapter: Adapter) -> Self:
        """Find what is read of a graph's outputs.

        Raises:
            EvaluationError: Nothing names the plan, or the graph has no such output.
        """
        return cls(
            adapter, plan_of(adapter.plan, session.metadata, list(session.outputs))
        )

    def trajectory(
        self,
        outputs: Mapping[str, Array],
        feeds: Mapping[str, Array],
        observation: Observation,
    ) -> Trajectory:
        """Return the plan in the ego frame.

        Args:
            outputs: Of the graph.
            feeds: What it was fed.
            observation: What that was made of.

        Raises:
            GraphError: See `PlanAdapter.plan`.
        """
        command = np.array([observation.command])
        points = self.plan.plan(outputs, {**feeds, "command": command})
        return self.plan.trajectory(self.adapter.to_ego(points))


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
