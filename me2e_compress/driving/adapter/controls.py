"""Read throttle, steering and brake from a model's outputs."""

import re
from collections.abc import Mapping
from typing import Self, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, model_validator

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


class ControlAdapter(BaseModel):
    """How to read controls from a model's outputs.

    Each number is an output with one element, ``steer``, or an element of a larger one,
    ``action[1]``, indexed over the flattened output. Give throttle and steer, with or
    without a brake; or one acceleration, which brakes below 0, and steer.

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
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    throttle: str | None = None
    brake: str | None = None
    acceleration: str | None = None
    steer: str | None = None
    throttle_range: Pair = (0.0, 1.0)
    brake_range: Pair = (0.0, 1.0)
    acceleration_range: Pair = (-1.0, 1.0)
    steer_range: Pair = (-1.0, 1.0)
    clip: bool = False

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        # exactly one way to read the controls
        named = {name for name in _NUMBERS if getattr(self, name) is not None}
        if named not in _FORMS:
            raise ValueError(
                "either throttle, steer and brake, or acceleration and steer"
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
        said = ((name, getattr(self, name)) for name in _NUMBERS)
        return {where: name for name, where in said if where is not None}

    def read(self, outputs: Outputs) -> PedalsAndWheel:
        """Return the model's controls."""
        steer = self._number("steer", outputs, -1.0)
        if self.acceleration is not None:
            said = self._number("acceleration", outputs, -1.0)
            # NaN stays NaN, on the throttle
            return PedalsAndWheel(max(said, 0.0), steer, max(0.0, -said))
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
    row = np.asarray(outputs[name], np.float64).reshape(-1)
    if index is None and len(row) != 1:
        raise EvaluationError(
            f"{name} has {len(row)} numbers: say which, {name}[0] for the first"
        )
    if index is not None and index >= len(row):
        raise EvaluationError(f"{name} has {len(row)} numbers: there is no {text}")
    return float(row[index or 0])
