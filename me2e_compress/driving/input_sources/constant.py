"""An input source of constants."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from me2e_compress.driving.input_sources.base import InputSource, Observed
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array

LARGEST = 1e18
"""The largest value: within int64."""


@dataclass(frozen=True)
class ConstantInput(InputSource):
    """The same numbers at every decision.

    Attributes:
        values: The numbers, row by row.
        shape: Their shape; empty for one row of them.
    """

    name: ClassVar[str] = "constant"
    values: tuple[float, ...]
    shape: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not all(abs(each) <= LARGEST for each in self.values):
            raise EvaluationError(f"constant: values must be finite, up to {LARGEST:g}")
        sides = self.shape or (len(self.values),)
        if min(sides) < 0 or math.prod(sides) != len(self.values):
            raise EvaluationError(
                f"constant: {len(self.values)} values have no shape {list(self.shape)}"
            )

    def value(self, seen: Observed) -> Array:
        """Return float64, or int64 where all values are whole numbers."""
        whole = all(each.is_integer() for each in self.values)
        array = np.array(self.values, np.int64 if whole else np.float64)
        return array.reshape(self.shape) if self.shape else array
