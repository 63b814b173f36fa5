"""Find which outputs are fed back as inputs at the next frame."""

import dataclasses
from collections.abc import Mapping

import onnx_ir as ir

from me2e_compress.base import documents
from me2e_compress.base.errors import GraphError

# Metadata key of the outputs whose rows are agents, in no order
SETS = "me2e.sets"
# Metadata key: JSON `{input: output}`, null for an input that is not fed back; `{}`
# where none is.
RECURRENT = "me2e.recurrent"

# Naming rules: input `X` pairs with `X_out`, `prev_X` also with `next_X`.
SUFFIX, BEFORE, AFTER = "_out", "prev_", "next_"


@dataclasses.dataclass(frozen=True)
class SessionPort:
    """An input or output as onnxruntime describes it.

    ``type`` is e.g. ``tensor(float)``; open dimensions of ``shape`` are a name or None.
    """

    type: str
    shape: tuple[int | str | None, ...]


def recurrence(
    metadata: Mapping[str, str],
    inputs: Mapping[str, SessionPort],
    outputs: Mapping[str, SessionPort],
) -> dict[str, str]:
    """Pair recurrent inputs with the outputs that are fed back to them.

    The metadata ``me2e.recurrent`` decides for the inputs and outputs it names, and for
    all where it is empty. Any other input ``X`` pairs with the output ``X_out``, and an
    input ``prev_X`` also with ``next_X``, if element type and rank agree.

    Raises:
        GraphError: the metadata is malformed, names an unknown port, or pairs ports of
            different types.
    """
    named = declared_pairs(metadata)
    if named == {}:
        return {}
    # The metadata comes first, then the naming rules.
    pairs = {source: to for source, to in (named or {}).items() if to is not None}
    for source, answer in pairs.items():
        if source not in inputs or answer not in outputs:
            raise GraphError(
                f"metadata {RECURRENT} pairs {source} with {answer}; the graph has"
                f" inputs {', '.join(inputs)} and outputs {', '.join(outputs)}"
            )
        if not _fits(inputs[source], outputs[answer]):
            why = _misfit(source, answer, inputs, outputs)
            raise GraphError(f"metadata {RECURRENT}: {why}")
    # An output feeds one input only.
    for source in inputs:
        output = _answer(source, outputs)
        if output is None or source in (named or {}) or output in pairs.values():
            continue
        if _fits(inputs[source], outputs[output]):
            pairs[source] = output
    return {source: pairs[source] for source in inputs if source in pairs}


def declared_pairs(metadata: Mapping[str, str]) -> dict[str, str | None] | None:
    """Return the pairs that the metadata declares; None where it declares nothing."""
    text = metadata.get(RECURRENT)
    if text is None:
        return None
    try:
        pairs = documents.from_json(text)
    except documents.MalformedError as error:
        raise GraphError(f"metadata {RECURRENT} is not JSON: {error}") from error
    if not isinstance(pairs, dict) or not all(
        answer is None or isinstance(answer, str) for answer in pairs.values()
    ):
        raise GraphError(f"metadata {RECURRENT} is not {{input: output}}: {text}")
    return dict(pairs)


def not_fed_back(
    name: str, inputs: Mapping[str, SessionPort], outputs: Mapping[str, SessionPort]
) -> str:
    """Explain why a missing input is not fed back; empty for a plain input."""
    answer = _answer(name, outputs)
    if answer is None and name.startswith(BEFORE):
        after = AFTER + name.removeprefix(BEFORE)
        return (
            f"; nothing feeds it back: no output is called {name}{SUFFIX} or {after},"
            f" and the metadata {RECURRENT} does not name it"
        )
    if answer is None or name not in inputs:
        return ""
    if _fits(inputs[name], outputs[answer]):
        return f"; {answer} is not fed back to it: the metadata {RECURRENT} decides so"
    return f"; nothing feeds it back: {_misfit(name, answer, inputs, outputs)}"


def _answer(source: str, outputs: Mapping[str, SessionPort]) -> str | None:
    """Return the output that the naming rules pair with an input."""
    names = [source + SUFFIX]
    if source.startswith(BEFORE):
        names.append(AFTER + source.removeprefix(BEFORE))
    return next((name for name in names if name in outputs), None)


def _misfit(
    source: str,
    answer: str,
    inputs: Mapping[str, SessionPort],
    outputs: Mapping[str, SessionPort],
) -> str:
    port_in, port_out = inputs[source], outputs[answer]
    return (
        f"output {answer} is {port_out.type} of rank {len(port_out.shape)}, input"
        f" {source} {port_in.type} of rank {len(port_in.shape)}"
    )


def recurrent_inputs(model: ir.Model) -> dict[str, str]:
    """Return the ``{recurrent input: output}`` of a graph in memory."""
    return recurrence(model.metadata_props, *sides(model))


def sides(model: ir.Model) -> tuple[dict[str, SessionPort], dict[str, SessionPort]]:
    """Return the inputs and the outputs of known rank of a graph in memory."""
    inputs, outputs = (
        {str(value.name): port_of(value) for value in values if value.shape is not None}
        for values in (model.graph.inputs, model.graph.outputs)
    )
    return inputs, outputs


def port_of(value: ir.Value) -> SessionPort:
    """Describe a value as onnxruntime does; a shape that is not known is empty."""
    kind, shape = str(value.type), value.shape
    if isinstance(value.type, ir.TensorType):
        kind = f"tensor({value.type.dtype.name.lower()})"
    dims = () if shape is None else shape
    return SessionPort(kind, tuple(d if isinstance(d, int) else d.value for d in dims))


def _fits(source: SessionPort, answer: SessionPort) -> bool:
    return source.type == answer.type and len(source.shape) == len(answer.shape)
