"""Read the planned waypoints off a model's outputs."""

from collections.abc import Mapping, Sequence
from typing import Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt
import pydantic

from me2e_compress import documents
from me2e_compress.errors import GraphError

PLAN = "me2e.plan"
"""Metadata key: JSON of :class:`PlanAdapter`."""

DEFAULT_OUTPUT = "plan"

Arrays: TypeAlias = Mapping[str, npt.NDArray[np.generic]]


class PlanAdapter(pydantic.BaseModel):
    """How to read waypoints off a model's outputs.

    Attributes:
        output: the output that holds the plan, [1, 6, 2] or, with modes,
            [1, modes, 6, 2]; metres.
        deltas: True where it holds steps from waypoint to waypoint, not positions.
        command_input: the input whose first element picks the mode.
        default_mode: the mode where no input picks one.
        scores: the output [1, modes] whose largest value picks the mode; not with
            ``command_input``.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    output: str
    deltas: bool = False
    command_input: str | None = None
    default_mode: int = 0
    scores: str | None = None

    @pydantic.model_validator(mode="after")
    def _one_choice(self) -> Self:
        if self.scores is not None and self.command_input is not None:
            raise ValueError("scores and command_input both pick the mode")
        return self

    @classmethod
    def of(cls, metadata: Mapping[str, str], outputs: Sequence[str]) -> Self | None:
        """Read it from a model's metadata; else an output named ``plan`` is the plan.

        Returns:
            The adapter; None if the model does not name its plan.

        Raises:
            GraphError: the metadata is malformed or names an output that is not there.
        """
        text = metadata.get(PLAN)
        if text is None:
            return cls(output=DEFAULT_OUTPUT) if DEFAULT_OUTPUT in outputs else None
        try:
            found = cls.model_validate(documents.from_json(text))
        except (documents.MalformedError, pydantic.ValidationError) as error:
            first = str(error).splitlines()[0]
            raise GraphError(
                f"metadata {PLAN} is not a plan adapter: {first}"
            ) from error
        for named in (found.output, found.scores):
            if named is not None and named not in outputs:
                raise GraphError(
                    f"metadata {PLAN} names output {named}; there is"
                    f" {', '.join(outputs)}"
                )
        return found

    def plan(self, outputs: Arrays, inputs: Arrays) -> npt.NDArray[np.float64]:
        """Return the waypoints, metres in the ego frame, float64 [waypoints, 2].

        Raises:
            GraphError: the output has another rank, or no such mode.
        """
        value = np.asarray(outputs[self.output], np.float64)
        if value.ndim == 4:
            mode = self._mode(inputs) if self.scores is None else self.choice(outputs)
            if not 0 <= mode < value.shape[1]:
                raise GraphError(
                    f"mode {mode} of {self.output}: it has {value.shape[1]} modes"
                )
            value = value[:, mode]
        if value.ndim != 3 or value.shape[0] != 1 or value.shape[2] != 2:
            raise GraphError(
                f"{self.output} has shape {list(value.shape)}, a plan is [1, n, 2]"
            )
        points: npt.NDArray[np.float64] = value[0]
        return np.cumsum(points, axis=0) if self.deltas else points

    def choice(self, outputs: Arrays) -> int:
        """Return the mode that the scores pick: their largest, the first of equals.

        Raises:
            GraphError: no output of scores is named.
        """
        if self.scores is None:
            raise GraphError(f"nothing names the scores of {self.output}")
        return int(np.argmax(np.asarray(outputs[self.scores], np.float64)[0]))

    def _mode(self, inputs: Arrays) -> int:
        if self.command_input is None or self.command_input not in inputs:
            return self.default_mode
        first: Any = np.asarray(inputs[self.command_input]).reshape(-1)[0]
        return int(first)
