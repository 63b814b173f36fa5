"""Read which checkpoint a graph was made from."""

from collections.abc import Mapping
from dataclasses import dataclass

import pydantic

from me2e_compress.registry.documents import MalformedError, from_json
from me2e_compress.shipped.drivers import SHIPPED

RECORD = "me2e.weights"
"""Metadata key of the checkpoint that a graph was made from."""


@dataclass(frozen=True)
class WeightsRecord:
    """The checkpoint of a graph's weights.

    Attributes:
        averaged: whether its moving averages were taken.
    """

    file: str
    sha256: str
    epoch: int | None = None
    iteration: int | None = None
    averaged: bool = False

    def line(self) -> str:
        """Return the line of a report."""
        counts = {"epoch": self.epoch, "iteration": self.iteration}
        stated = [f"{key} {n}" for key, n in counts.items() if n is not None]
        return ", ".join([f"weights: {self.file}", *stated, f"sha256 {self.sha256}"])


def named_weights(metadata: Mapping[str, str]) -> str:
    """Return the line that names a graph's checkpoint or random weights, if known."""
    text = metadata.get(RECORD)
    if text is None:
        stack = metadata.get("me2e.stack")
        if stack is None or stack in SHIPPED:
            return ""
        return f"weights: random, as {stack} is exported: no {RECORD} names others"
    try:
        record = pydantic.TypeAdapter(WeightsRecord).validate_python(from_json(text))
    except (MalformedError, pydantic.ValidationError):
        return f"metadata {RECORD} is malformed"
    return record.line()
