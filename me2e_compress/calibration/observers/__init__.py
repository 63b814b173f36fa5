"""Observers compute one range per tensor from statistics.

To add an observer, write its class, then add it to this table.
"""

from me2e_compress.calibration.observers.base import (
    QUANT_MAX,
    Bounds,
    Observer,
    scale_of,
)
from me2e_compress.errors import RecipeError
from me2e_compress.registry import Registry

__all__ = ["OBSERVERS", "QUANT_MAX", "Bounds", "Observer", "scale_of"]

_HERE = "me2e_compress.calibration.observers"

DEFAULT_METHOD = "mse"
"""It drives no worse than max-min, and the plan moves less, from each of three
recordings, by a rule that was written down before the drives (tag ``road-1``)."""

OBSERVERS: Registry[Observer] = Registry(
    "calibration method",
    "me2e_compress.observers",
    RecipeError,
    {
        "max-min": f"{_HERE}.base:MaxMin",
        "percentile": f"{_HERE}.histogram:Percentile",
        "mse": f"{_HERE}.histogram:MeanSquaredError",
    },
)
