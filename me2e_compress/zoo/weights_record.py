"""Which checkpoint a graph was made of."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import pydantic

from me2e_compress.documents import MalformedError, from_json
from me2e_compress.zoo.stacks import STACKS

RECORD = "me2e.weights"
"""Key of the metadata that says which checkpoint a graph was made of."""


@dataclass(frozen=True)
class WeightsRecord:
    """What is known of the weights in a graph, and what became of the rest of a file.

    Attributes:
        file: Name of the checkpoint.
        sha256: Of it, lower-case hex.
        epoch: That it states.
        iteration: That it states.
        averaged: Its moving averages were taken.
        converted: How many tensors became float32, by the type they had.
        unread: Names of tensors left out, since driving does not read them.
        averages: How many moving averages were left out.
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
        """Return what there is to say, a line each."""
        counts = {"epoch": self.epoch, "iteration": self.iteration}
        stated = [f"{key} {n}" for key, n in counts.items() if n is not None]
        said = [", ".join([f"weights: {self.file}", *stated, f"sha256 {self.sha256}"])]
        for type_, count in self.converted.items():
            said.append(f"{count} tensors of {type_} converted to float32")
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
    """Return the line that names the checkpoint of a graph; empty if nothing is known.

    A stack that was exported without one has random weights.

    Args:
        metadata: Of the graph, by key.
    """
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
