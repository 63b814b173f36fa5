"""Read the planned waypoints from a model's outputs."""

from collections.abc import Mapping, Sequence
from typing import Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt
import pydantic

from me2e_compress.errors import GraphError
from me2e_compress.registry import documents
from me2e_compress.runtime.trajectory import Trajectory

PLAN = "me2e.plan"
"""Metadata key: JSON of :class:`PlanAdapter`."""

DEFAULT_OUTPUT = "plan"

CONTRACT_WAYPOINTS, CONTRACT_STEP_S = 6, 0.5
"""Waypoints, and seconds between them, of a plan that does not state its step."""

Arrays: TypeAlias = Mapping[str, npt.NDArray[np.generic]]


class PlanAdapter(pydantic.BaseModel):
    """How to read waypoints from a model's outputs.

    Attributes:
        output: the output that holds the plan, [1, n, 2] or, with modes,
            [1, modes, n, 2]; metres.
        deltas: True where it holds steps from waypoint to waypoint, not positions.
        command_input: the input that selects the mode: its first element, or the argmax
            of a one-hot vector.
        command_modes: the mode of each command, where the numbers differ.
        default_mode: the mode where no input selects one; several modes need one of
            these three.
        scores: the output [1, modes] whose largest value selects the mode; not with
            ``command_input``.
        step_s: seconds between waypoints; None means 0.5, only for six waypoints.
        first_s: time of the first waypoint; None means one step. Waypoints at 0 s and
            before, where the ego is and was, are dropped.
        shape: layout of a flat output, [n, values] or [modes, n, values].
        columns: which of a waypoint's values are its coordinates: a heading or a speed
            may be stored with them.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    output: str
    deltas: bool = False
    command_input: str | None = None
    command_modes: tuple[int, ...] | None = None
    default_mode: int | None = None
    scores: str | None = None
    step_s: float | None = pydantic.Field(default=None, gt=0.0, le=10.0)
    first_s: float | None = None
    shape: tuple[int, ...] | None = pydantic.Field(
        default=None, min_length=2, max_length=3
    )
    columns: tuple[int, int] | None = None

    @pydantic.model_validator(mode="after")
    def _one_choice(self) -> Self:
        if self.scores is not None and self.command_input is not None:
            raise ValueError("scores and command_input both pick the mode")
        if self.command_modes is not None and self.command_input is None:
            raise ValueError("command_modes without command_input")
        if self.shape is not None and min(self.shape) < 1:
            raise ValueError(f"shape {list(self.shape)}: every side is 1 or more")
        if self.columns is not None and min(self.columns) < 0:
            raise ValueError(f"columns {list(self.columns)}: they count from 0")
        return self

    @classmethod
    def of(cls, metadata: Mapping[str, str], outputs: Sequence[str]) -> Self | None:
        """Read the adapter from a model's metadata, or use an output named ``plan``.

        Returns None if the model names no plan; malformed metadata is a GraphError.
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
        # A name that is not an output is an error here.
        for named in (found.output, found.scores):
            if named is not None and named not in outputs:
                raise GraphError(
                    f"metadata {PLAN} names output {named}; there is"
                    f" {', '.join(outputs)}"
                )
        return found

    def plan(self, outputs: Arrays, inputs: Arrays) -> npt.NDArray[np.float64]:
        """Return the waypoints, metres in the model's frame, float64 [waypoints, 2].

        Raises:
            GraphError: the output has the wrong shape, or no mode is selected.
        """
        value = self._laid_out(np.asarray(outputs[self.output], np.float64))
        # Choose the mode, then read the coordinates.
        if value.ndim == 4:
            value = value[:, self._mode(outputs, inputs, value.shape[1])]
        if value.ndim != 3 or value.shape[0] != 1:
            raise GraphError(self._not_a_plan(value.shape))
        points: npt.NDArray[np.float64] = self._coordinates(value)[0]
        return np.cumsum(points, axis=0) if self.deltas else points

    def trajectory(self, points: npt.NDArray[np.float64]) -> Trajectory:
        """Return waypoints, in any frame, with their times, if the step is known."""
        if self.step_s is None and len(points) != CONTRACT_WAYPOINTS:
            raise GraphError(
                f"output {self.output}: the plan has shape {list(points.shape)}, it"
                f" must be [{CONTRACT_WAYPOINTS}, 2], or step_s must say how far apart"
                " its waypoints are"
            )
        step = CONTRACT_STEP_S if self.step_s is None else self.step_s
        first = step if self.first_s is None else self.first_s
        # whole microseconds: 3 x 0.1 is a little more than 0.3
        times = np.round(first + step * np.arange(len(points)), 6)
        return Trajectory.ahead(points, times)

    def check_modes(self, modes: int) -> None:
        """Check that something selects one of several modes; GraphError if not."""
        picks = self.default_mode, self.command_input, self.scores
        if modes > 1 and all(each is None for each in picks):
            raise GraphError(
                f"{self.output} has {modes} modes and nothing picks one: name"
                f" command_input, scores or default_mode, in the metadata {PLAN} or in"
                " an adapter's [plan]"
            )

    def choice(self, outputs: Arrays) -> int:
        """Return the mode with the largest score, the first of equals."""
        if self.scores is None:
            raise GraphError(f"nothing names the scores of {self.output}")
        return int(np.argmax(np.asarray(outputs[self.scores], np.float64).reshape(-1)))

    def _laid_out(self, value: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        if self.shape is None:
            return value
        if value.size != int(np.prod(self.shape)):
            raise GraphError(
                f"{self.output} has shape {list(value.shape)}, which cannot be laid out"
                f" as {list(self.shape)}"
            )
        return value.reshape(1, *self.shape)

    def _coordinates(self, value: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        if self.columns is None:
            if value.shape[-1] != 2:
                raise GraphError(self._not_a_plan(value.shape))
            return value
        if max(self.columns) >= value.shape[-1]:
            raise GraphError(
                f"{self.output} has shape {list(value.shape)}: there is no column"
                f" {max(self.columns)}"
            )
        return value[..., self.columns]

    def _not_a_plan(self, shape: tuple[int, ...]) -> str:
        return f"{self.output} has shape {list(shape)}, a plan is [1, n, 2]"

    def _mode(self, outputs: Arrays, inputs: Arrays, modes: int) -> int:
        mode = self._picked(outputs, inputs, modes)
        if not 0 <= mode < modes:
            raise GraphError(f"mode {mode} of {self.output}: it has {modes} modes")
        return mode

    def _picked(self, outputs: Arrays, inputs: Arrays, modes: int) -> int:
        if self.scores is not None:
            if (count := np.size(outputs[self.scores])) != modes:
                raise GraphError(
                    f"{self.scores} has {count} scores, and {self.output} {modes} modes"
                )
            return self.choice(outputs)
        # A command is a number, or a one-hot vector.
        if self.command_input is not None and self.command_input in inputs:
            given: Any = np.asarray(inputs[self.command_input]).reshape(-1)
            command = int(given[0] if len(given) == 1 else np.argmax(given))
            return self._mode_of(command)
        # Without scores or a command, only a default mode is left.
        self.check_modes(modes)
        return self.default_mode or 0

    def _mode_of(self, command: int) -> int:
        if self.command_modes is None:
            return command
        if not 0 <= command < len(self.command_modes):
            raise GraphError(
                f"{self.output}: command_modes names no mode of command {command}"
            )
        return self.command_modes[command]
