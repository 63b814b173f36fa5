"""Record which checkpoint a graph was made from."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import pydantic

from me2e_compress.registry.documents import MalformedError, from_json
from me2e_compress.zoo.stacks import STACKS

RECORD = "me2e.weights"
"""Metadata key of the checkpoint that a graph was made from."""


@dataclass(frozen=True)
class WeightsRecord:
    """The checkpoint of a graph's weights, and what was not used of it.

    Attributes:
        averaged: whether its moving averages were taken.
        converted: number of tensors made float32, by old type.
        unread: names of omitted tensors; driving does not use them.
        averages: number of moving averages that were not used.
    """

    file: str
    sha256: str
    epoch: int | None = None
    iteration: int | None = None
    averaged: bool = False
    converted: Mapping[str, int] = field(default_factory=dict)
    unread: Sequence[str] = ()
    averages: int = 0

    def metadata(self) -> dict[str, str]:
        """Return the ONNX metadata property that names the checkpoint."""
        keys = ("file", "sha256", "epoch", "iteration", "averaged")
        return {RECORD: json.dumps({key: getattr(self, key) for key in keys})}

    def lines(self) -> tuple[str, ...]:
        """Return the lines of a report."""
        # What the graph was made from
        counts = {"epoch": self.epoch, "iteration": self.iteration}
        stated = [f"{key} {n}" for key, n in counts.items() if n is not None]
        said = [", ".join([f"weights: {self.file}", *stated, f"sha256 {self.sha256}"])]
        for type_, count in self.converted.items():
            said.append(f"{count} tensors of {type_} converted to float32")
        # What was not used
        if self.unread:
            parts = list(dict.fromkeys(name.split(".")[0] for name in self.unread))
            said.append(
                f"left out, {len(self.unread)} tensors that driving does not read:"
                f" {', '.join(parts)}"
            )
        if self.averages:
            said.append(f"left out: {self.averages} moving averages; --ema takes them")
        return tuple(said)


def named_weights(metadata: Mapping[str, str]) -> str:
    """Return the line that names a graph's checkpoint or random weights, if known."""
    text = metadata.get(RECORD)
    if text is None:
        stack = STACKS.get(metadata.get("me2e.stack", ""))
        if stack is None or stack.trained:
            return ""
        return f"weights: random, as {stack.name} is exported: no {RECORD} names others"
    try:
        record = pydantic.TypeAdapter(WeightsRecord).validate_python(from_json(text))
    except (MalformedError, pydantic.ValidationError):
        return f"metadata {RECORD} is malformed"
    return record.lines()[0]
