"""From what was seen on the frames to one range a tensor."""

import dataclasses
from collections.abc import Callable

from me2e_compress.calibration.observers.base import Observer
from me2e_compress.calibration.observers.extremes import MaxMin, MovingAverage
from me2e_compress.calibration.observers.histogram import (
    Entropy,
    MeanSquaredError,
    Percentile,
)
from me2e_compress.calibration.observers.scale import QUANT_MAX, scale_of
from me2e_compress.errors import RecipeError

__all__ = [
    "METHODS",
    "QUANT_MAX",
    "Entropy",
    "MaxMin",
    "MeanSquaredError",
    "MovingAverage",
    "Observer",
    "Percentile",
    "observer",
    "scale_of",
]

METHODS: dict[str, Callable[[], Observer]] = {
    MaxMin.name: MaxMin,
    MovingAverage.name: MovingAverage,
    Percentile.name: Percentile,
    MeanSquaredError.name: MeanSquaredError,
    Entropy.name: Entropy,
}

_LIMITS = {MovingAverage.name: 1.0, Percentile.name: 100.0}
"""The largest number that a method takes; it must be above 0."""


def observer(method: str) -> Observer:
    """Read a method: its name, and a number where it takes one, ``percentile:99.9``.

    Raises:
        RecipeError: no such method, no number wanted, or the number is out of range.
    """
    name, colon, text = method.partition(":")
    if name not in METHODS:
        raise RecipeError(
            f"no calibration method {name}; there is {', '.join(METHODS)}, all int8"
        )
    made = METHODS[name]()
    if not colon:
        return made
    if name not in _LIMITS:
        raise RecipeError(f"calibration method {name} takes no number, found {text!r}")
    number = _number(text)
    if number is None or not 0 < number <= _LIMITS[name]:
        raise RecipeError(
            f"calibration method {name} takes a number above 0 and at most"
            f" {_LIMITS[name]:g}, found {text!r}"
        )
    if isinstance(made, MovingAverage):
        return dataclasses.replace(made, weight=number)
    return Percentile(number)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
