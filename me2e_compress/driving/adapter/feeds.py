"""One input of a graph, made of input sources."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, model_validator

from me2e_compress.driving.input_sources import INPUT_SOURCES, InputSource, Observed
from me2e_compress.driving.input_sources.navigation import NavigationCommand
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array

Levels = float | tuple[float, ...]

LARGEST = 1e30
"""The largest mean or std: within float32."""


@dataclass(frozen=True)
class FeedPart:
    """A source, normalised: (value - mean) / std.

    ``mean`` and ``std`` are one number, or as many as the last dimension has.
    """

    source: InputSource
    mean: Levels = 0.0
    std: Levels = 1.0

    @classmethod
    def read(cls, table: dict[str, Any]) -> Self:
        """Read a table: source, mean, std, and the source's own options."""
        options = dict(table)
        name = options.pop("source", None)
        if not isinstance(name, str):
            names = ", ".join(INPUT_SOURCES.names())
            raise ValueError(f"no source is named; there are {names}")
        # what is left of the table are the source's options
        mean = _levels("mean", options.pop("mean", 0.0))
        std = _levels("std", options.pop("std", 1.0))
        if not np.all(std):
            raise ValueError(f"{name}: std is zero")
        try:
            return cls(INPUT_SOURCES.build(name, options), mean, std)
        except EvaluationError as error:
            raise ValueError(str(error)) from error

    def value(self, seen: Observed) -> Array:
        """Return the normalised value, of the source's shape."""
        array = self.source.value(seen)
        if self.mean == 0.0 and self.std == 1.0:
            return array
        try:
            scaled: Array = (array - np.array(self.mean)) / np.array(self.std)
        except ValueError as error:
            raise EvaluationError(
                f"{self.source.name}: mean or std: {error}"
            ) from error
        # numpy may have broadcast to a larger shape
        if scaled.shape != array.shape:
            raise EvaluationError(
                f"{self.source.name}: mean and std make {list(scaled.shape)} of its "
                f"shape {list(array.shape)}"
            )
        return scaled


class Feed(BaseModel):
    """How one input is made: of a source, or of parts in a row.

    As a table: ``source`` and its options, ``mean``, ``std``; or ``parts``, a list of
    such tables, whose numbers are flattened and concatenated (``joined``).
    """

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True)

    parts: tuple[FeedPart, ...]
    joined: bool = False

    @model_validator(mode="before")
    @classmethod
    def _of_table(cls, table: Any) -> Any:
        if not isinstance(table, dict):
            raise ValueError("it must be a table with a source, or with parts")
        if "parts" not in table:
            return {"parts": (FeedPart.read(table),)}
        # parts, each a table of its own
        listed = table["parts"]
        if not (isinstance(listed, list) and listed) or len(table) > 1:
            raise ValueError("parts must be a list of tables, and stand alone")
        if not all(isinstance(each, dict) for each in listed):
            raise ValueError("each of parts must be a table with a source")
        return {"parts": tuple(map(FeedPart.read, listed)), "joined": True}

    @classmethod
    def by(cls, source: InputSource) -> Self:
        """Return the feed of one source without normalisation."""
        return cls.model_construct(parts=(FeedPart(source),))

    def value(self, seen: Observed) -> Array:
        """Return the input's value, without a batch dimension."""
        arrays = [part.value(seen) for part in self.parts]
        if not self.joined:
            return arrays[0]
        return np.concatenate([each.reshape(-1) for each in arrays])

    def sizes(self, seen: Observed) -> str:
        """Name the sources with their element counts, for messages."""
        found = ((p.source.name, p.source.value(seen).size) for p in self.parts)
        return ", ".join(f"{name} {size}" for name, size in found)

    @property
    def command(self) -> NavigationCommand | None:
        """The navigation command, if the feed is nothing else."""
        source = self.parts[0].source
        if len(self.parts) > 1 or not isinstance(source, NavigationCommand):
            return None
        return source


def _levels(name: str, value: Any) -> Levels:
    numbers = value if isinstance(value, list) else [value]
    if not numbers or not all(
        isinstance(each, int | float)
        and not isinstance(each, bool)
        and abs(each) <= LARGEST
        for each in numbers
    ):
        raise ValueError(f"{name} must be a finite number, or a list of such")
    return tuple(map(float, value)) if isinstance(value, list) else float(value)
