"""Which outputs come back as inputs at the next frame."""

import dataclasses
from collections.abc import Mapping, Sequence

import onnx_ir as ir

from me2e_compress import documents
from me2e_compress.errors import GraphError

RECURRENT = "me2e.recurrent"
"""Metadata key: JSON ``{input: output}``; ``{}`` where nothing is fed back."""

SUFFIX = "_out"


@dataclasses.dataclass(frozen=True)
class SessionPort:
    """An input or output as onnxruntime sees it.

    Attributes:
        type: element type, e.g. ``tensor(float)``.
        shape: dimensions; a name or None where the size is open.
    """

    type: str
    shape: tuple[int | str | None, ...]


def recurrence(
    metadata: Mapping[str, str],
    inputs: Mapping[str, SessionPort],
    outputs: Mapping[str, SessionPort],
) -> dict[str, str]:
    """Pair recurrent inputs with the outputs that answer them.

    The metadata decides where it has ``me2e.recurrent``; without it, an input ``X``
    belongs to the output ``X_out`` of the same element type and rank.

    Raises:
        GraphError: the metadata is not such a mapping, names an unknown port, or
            pairs ports of different types.
    """
    text = metadata.get(RECURRENT)
    if text is None:
        return {
            name: name + SUFFIX
            for name in inputs
            if name + SUFFIX in outputs and _fits(inputs[name], outputs[name + SUFFIX])
        }
    pairs = _parse(text)
    for source, answer in pairs.items():
        if source not in inputs or answer not in outputs:
            raise GraphError(
                f"metadata {RECURRENT} pairs {source} with {answer}; the graph has"
                f" inputs {', '.join(inputs)} and outputs {', '.join(outputs)}"
            )
        if not _fits(inputs[source], outputs[answer]):
            raise GraphError(
                f"metadata {RECURRENT} feeds {answer} ({outputs[answer].type} of rank"
                f" {len(outputs[answer].shape)}) back as {source}"
                f" ({inputs[source].type} of rank {len(inputs[source].shape)})"
            )
    return pairs


def recurrent_inputs(model: ir.Model) -> dict[str, str]:
    """Return the ``{recurrent input: output}`` of a graph in memory."""
    return recurrence(
        model.metadata_props, _ports(model.graph.inputs), _ports(model.graph.outputs)
    )


def _ports(values: Sequence[ir.Value]) -> dict[str, SessionPort]:
    return {
        str(value.name): SessionPort(
            str(value.type), tuple(d if isinstance(d, int) else str(d) for d in shape)
        )
        for value in values
        if (shape := value.shape) is not None
    }


def _parse(text: str) -> dict[str, str]:
    try:
        pairs = documents.from_json(text)
    except documents.MalformedError as error:
        raise GraphError(f"metadata {RECURRENT} is not JSON: {error}") from error
    if not isinstance(pairs, dict) or not all(
        isinstance(answer, str) for answer in pairs.values()
    ):
        raise GraphError(f"metadata {RECURRENT} is not {{input: output}}: {text}")
    return dict(pairs)


def _fits(source: SessionPort, answer: SessionPort) -> bool:
    return source.type == answer.type and len(source.shape) == len(answer.shape)
