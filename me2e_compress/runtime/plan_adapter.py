"""Read the planned waypoints from a model's outputs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt
import pydantic

from me2e_compress.base import documents
from me2e_compress.base.errors import EvaluationError, GraphError

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class Trajectory:
    """The planned path of the ego.

    Attributes:
        points: [n, 2] metres, n at least 1; x forward, y left in the ego frame of the
            observation.
        times_s: [n] seconds after the observation, above 0 and increasing.

    Raises:
        EvaluationError: another shape, or times that do not increase from above 0.
    """

    points: npt.NDArray[np.floating]
    times_s: npt.NDArray[np.floating]

    def __post_init__(self) -> None:
        """Check shapes and times; the driver checks that the points are finite."""
        shape, times = list(self.points.shape), self.times_s
        if len(shape) != 2 or shape[1] != 2 or not shape[0]:
            raise EvaluationError(f"waypoints have shape {shape}, they must be [n, 2]")
        if times.shape != (shape[0],):
            raise EvaluationError(
                f"{shape[0]} waypoints and times of shape {list(times.shape)}"
            )
        if not (np.diff(times, prepend=0.0) > 0).all():
            raise EvaluationError("times of waypoints must increase from above 0")

    @classmethod
    def ahead(
        cls, points: npt.NDArray[np.floating], times_s: npt.NDArray[np.floating]
    ) -> Self:
        """Build one of the waypoints after 0 s; an EvaluationError if there is none."""
        if not (times_s > 0).any():
            raise EvaluationError("no waypoint lies after the observation")
        return cls(points[times_s > 0], times_s[times_s > 0])

    def at(self, times_s: npt.NDArray[np.floating]) -> Floats:
        """Return the positions [m, 2] at other times [m] from 0 on."""
        # Interpolate linearly, from the ego at 0 s; after the last waypoint continue at
        # the last velocity
        times = np.concatenate([[0.0], self.times_s])
        points = np.vstack([np.zeros((1, 2)), self.points])
        velocity = (points[-1] - points[-2]) / (times[-1] - times[-2])
        times_asked = np.asarray(times_s, np.float64)
        x, y = (np.interp(times_asked, times, column) for column in points.T)
        overshoot_s = np.maximum(times_asked - times[-1], 0.0)
        positions: Floats = np.stack([x, y], axis=1) + overshoot_s[:, None] * velocity
        return positions


# Metadata key: JSON of `PlanAdapter`.
PLAN = "me2e.plan"

DEFAULT_OUTPUT = "plan"

# Waypoints, and seconds between them, of a plan that does not state its step
CONTRACT_WAYPOINTS, CONTRACT_STEP_S = 6, 0.5

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
    def _check_fields(self) -> Self:
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
        """Read the adapter from metadata, or take the output ``plan``; None without."""
        text = metadata.get(PLAN)
        if text is None:
            return cls(output=DEFAULT_OUTPUT) if DEFAULT_OUTPUT in outputs else None
        try:
            adapter = cls.model_validate(documents.from_json(text))
        except (documents.MalformedError, pydantic.ValidationError) as error:
            first = str(error).splitlines()[0]
            raise GraphError(
                f"metadata {PLAN} is not a plan adapter: {first}"
            ) from error
        # A name that is not an output is an error here.
        for named in (adapter.output, adapter.scores):
            if named is not None and named not in outputs:
                raise GraphError(
                    f"metadata {PLAN} names output {named}; there is"
                    f" {', '.join(outputs)}"
                )
        return adapter

    def plan(self, outputs: Arrays, inputs: Arrays) -> npt.NDArray[np.float64]:
        """Return the waypoints in the model's frame, metres: float64 [waypoints, 2]."""
        value = np.asarray(outputs[self.output], np.float64)
        # Lay out a flat output.
        if self.shape is not None:
            if value.size != int(np.prod(self.shape)):
                raise GraphError(
                    f"{self.output} has shape {list(value.shape)}, which cannot be laid"
                    f" out as {list(self.shape)}"
                )
            value = value.reshape(1, *self.shape)
        # Choose the mode, then read the coordinates.
        if value.ndim == 4:
            modes = value.shape[1]
            mode = self._selected_mode(outputs, inputs, modes)
            if not 0 <= mode < modes:
                raise GraphError(f"mode {mode} of {self.output}: it has {modes} modes")
            value = value[:, mode]
        shape = list(value.shape)
        if (
            len(shape) != 3
            or shape[0] != 1
            or (self.columns is None and shape[-1] != 2)
        ):
            raise GraphError(f"{self.output} has shape {shape}, a plan is [1, n, 2]")
        if self.columns is not None:
            if max(self.columns) >= shape[-1]:
                raise GraphError(
                    f"{self.output} has shape {shape}: there is no column"
                    f" {max(self.columns)}"
                )
            value = value[..., self.columns]
        points: npt.NDArray[np.float64] = value[0]
        return np.cumsum(points, axis=0) if self.deltas else points

    def trajectory(self, points: npt.NDArray[np.float64]) -> Trajectory:
        """Return waypoints [n, 2] with their times; a GraphError without a step."""
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
        if modes > 1 and all(pick is None for pick in picks):
            raise GraphError(
                f"{self.output} has {modes} modes and nothing picks one: name"
                f" command_input, scores or default_mode, in the metadata {PLAN} or in"
                " an adapter's [plan]"
            )

    def choice(self, outputs: Arrays) -> int:
        """Return the first mode of the largest score; a GraphError without scores."""
        if self.scores is None:
            raise GraphError(f"nothing names the scores of {self.output}")
        return int(np.argmax(np.asarray(outputs[self.scores], np.float64).reshape(-1)))

    def _selected_mode(self, outputs: Arrays, inputs: Arrays, modes: int) -> int:
        """Return the mode that scores, a command or the default selects."""
        if self.scores is not None:
            if (count := np.size(outputs[self.scores])) != modes:
                raise GraphError(
                    f"{self.scores} has {count} scores, and {self.output} {modes} modes"
                )
            return self.choice(outputs)
        # A command is a number, or a one-hot vector.
        if self.command_input is not None and self.command_input in inputs:
            command_values: Any = np.asarray(inputs[self.command_input]).reshape(-1)
            command = int(
                command_values[0]
                if len(command_values) == 1
                else np.argmax(command_values)
            )
            if self.command_modes is None:
                return command
            if not 0 <= command < len(self.command_modes):
                raise GraphError(
                    f"{self.output}: command_modes names no mode of command {command}"
                )
            return self.command_modes[command]
        # Without scores or a command, only a default mode is left.
        self.check_modes(modes)
        return self.default_mode or 0
