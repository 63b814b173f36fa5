"""Read throttle, steering and brake from a model's outputs."""

import re
from collections.abc import Mapping
from typing import Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from me2e_compress.driving.contract import PedalsAndWheel
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array

Pair: TypeAlias = tuple[float, float]
Outputs: TypeAlias = Mapping[str, Array]

_ELEMENT = re.compile(r"(?P<output>.+)\[(?P<index>\d+)\]")
_PEDALS = ("throttle", "brake", "acceleration")
_NUMBERS = ("steer", *_PEDALS)
_FORMS = (
    {"throttle", "steer"},
    {"throttle", "steer", "brake"},
    {"acceleration", "steer"},
)


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class BetaActions(_Table):
    """Beta distributions of acceleration and steer, as in OpenDriveLab's TCP.

    An action of 0 to 1 is mapped to -1 to 1: full brake to full throttle, full left to
    full right.

    Attributes:
        alpha: The output with both alphas, acceleration first.
        beta: The output with both betas, acceleration first.
        take: The ``mode``, as TCP's agent does: if both parameters are 1 or less there
            is no mode and the mean is taken; if one is, the mode is the end of the
            range on the other's side. Or the ``mean``.
    """

    alpha: str
    beta: str
    take: Literal["mode", "mean"] = "mode"

    def read(self, outputs: Outputs) -> PedalsAndWheel:
        """Return the action."""
        alpha, beta = (_row(outputs, name, 2) for name in (self.alpha, self.beta))
        if not (np.minimum(alpha, beta) >= 0).all() or np.isinf(alpha + beta).any():
            raise EvaluationError(
                f"{self.alpha} and {self.beta} are {alpha.tolist()} and"
                f" {beta.tolist()}: no parameters of a Beta distribution"
            )
        # from 0 to 1 to -1 to 1
        pairs = zip(alpha.tolist(), beta.tolist(), strict=True)
        chosen = (self._chosen(a, b) for a, b in pairs)
        acceleration, steer = (2.0 * each - 1.0 for each in chosen)
        return _by_acceleration(acceleration, steer)

    def _chosen(self, alpha: float, beta: float) -> float:
        if self.take == "mode" and max(alpha, beta) > 1.0:
            ahead, back = max(alpha - 1.0, 0.0), max(beta - 1.0, 0.0)
            return ahead / (ahead + back)
        # TCP's smallest sum: two zeros say nothing and give 0
        return alpha / max(alpha + beta, 1e-5)


class ScoredActions(_Table):
    """A choice among fixed actions, as in Bench2DriveZoo's TCP.

    Attributes:
        scores: The output with one score per action.
        actions: Throttle, steer and brake of each action.
    """

    scores: str
    actions: tuple[tuple[float, float, float], ...] = Field(min_length=1)

    def read(self, outputs: Outputs) -> PedalsAndWheel:
        """Return the action with the largest score, the first of equals."""
        scores = _row(outputs, self.scores, len(self.actions))
        if not np.isfinite(scores).all():
            raise EvaluationError(f"a score of {self.scores} is not finite")
        return PedalsAndWheel(*self.actions[int(np.argmax(scores))])


class ControlAdapter(_Table):
    """How to read controls from a model's outputs.

    Each number is an output with one element, ``steer``, or an element of a larger one,
    ``action[1]``, indexed over the flattened output. Give throttle and steer, with or
    without a brake; or one acceleration, which brakes below 0, and steer; or ``beta``;
    or ``scored``.

    Attributes:
        throttle: The output or element that holds the throttle.
        brake: The output or element that holds the brake.
        acceleration: The output or element that replaces throttle and brake.
        steer: The output or element that holds the steering.
        throttle_range: The model's values at no and at full throttle.
        brake_range: The model's values at no and at full brake.
        acceleration_range: The model's values at full brake and at full throttle.
        steer_range: The model's values at full left and at full right.
        clip: Whether values beyond their range are clipped; else they end the route.
        beta: Beta distributions in place of all these.
        scored: A choice among actions in place of all these.
    """

    throttle: str | None = None
    brake: str | None = None
    acceleration: str | None = None
    steer: str | None = None
    throttle_range: Pair = (0.0, 1.0)
    brake_range: Pair = (0.0, 1.0)
    acceleration_range: Pair = (-1.0, 1.0)
    steer_range: Pair = (-1.0, 1.0)
    clip: bool = False
    beta: BetaActions | None = None
    scored: ScoredActions | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        # exactly one way to read the controls
        named = {name for name in _NUMBERS if getattr(self, name) is not None}
        tables = sum(table is not None for table in (self.beta, self.scored))
        if tables + (named in _FORMS) != 1 or (tables and named):
            raise ValueError(
                "either throttle, steer and brake, or acceleration and steer, or beta,"
                " or scored"
            )
        # ranges that can be divided by
        for name in _NUMBERS:
            nothing, full = getattr(self, f"{name}_range")
            if nothing == full:
                raise ValueError(f"{name}_range: both ends are {full:g}")
        return self

    @property
    def outputs(self) -> dict[str, str]:
        """The output or element of each quantity, by its name in the document."""
        if self.beta is not None:
            both = "of acceleration and steer"
            return {self.beta.alpha: f"alpha {both}", self.beta.beta: f"beta {both}"}
        if self.scored is not None:
            return {self.scored.scores: f"scores of {len(self.scored.actions)} actions"}
        said = ((name, getattr(self, name)) for name in _NUMBERS)
        return {where: name for name, where in said if where is not None}

    def read(self, outputs: Outputs) -> PedalsAndWheel:
        """Return the model's controls."""
        table = self.beta or self.scored
        if table is not None:
            return table.read(outputs)
        steer = self._number("steer", outputs, -1.0)
        if self.acceleration is not None:
            return _by_acceleration(self._number("acceleration", outputs, -1.0), steer)
        throttle = self._number("throttle", outputs, 0.0)
        brake = 0.0 if self.brake is None else self._number("brake", outputs, 0.0)
        return PedalsAndWheel(throttle, steer, brake)

    def _number(self, name: str, outputs: Outputs, least: float) -> float:
        """Return a number from ``least`` to 1, the ends of its range."""
        said = element(outputs, getattr(self, name))
        begin, end = getattr(self, f"{name}_range")
        share = (said - begin) / (end - begin)
        value: float = least + (1.0 - least) * share
        return min(max(value, least), 1.0) if self.clip else value


def output_named(text: str, outputs: Mapping[str, object]) -> tuple[str, int | None]:
    """Split ``name`` or ``name[k]`` into the output's name and k."""
    found = None if text in outputs else _ELEMENT.fullmatch(text)
    if found is None:
        return text, None
    return found["output"], int(found["index"])


def element(outputs: Outputs, text: str) -> float:
    """Return the number that ``name`` or ``name[k]`` refers to."""
    name, index = output_named(text, outputs)
    row = _row(outputs, name, None)
    if index is None and len(row) != 1:
        raise EvaluationError(
            f"{name} has {len(row)} numbers: say which, {name}[0] for the first"
        )
    if index is not None and index >= len(row):
        raise EvaluationError(f"{name} has {len(row)} numbers: there is no {text}")
    return float(row[index or 0])


def _row(outputs: Outputs, name: str, size: int | None) -> npt.NDArray[np.float64]:
    row = np.asarray(outputs[name], np.float64).reshape(-1)
    if size is not None and len(row) != size:
        raise EvaluationError(f"{name} has {len(row)} numbers, it must have {size}")
    return row


def _by_acceleration(acceleration: float, steer: float) -> PedalsAndWheel:
    """Map above 0 to throttle, below to brake; NaN stays NaN, on the throttle."""
    return PedalsAndWheel(max(acceleration, 0.0), steer, max(0.0, -acceleration))
