"""Apply what an adapter says about a graph's state and plan to its metadata."""

from pathlib import Path

import onnx_ir as ir

from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.adapter.outputs import plan_of
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.graph.recurrence import recurrent_inputs


def adapted(model: ir.Model, adapter: str | Path | None) -> dict[str, str]:
    """Write an adapter's statements into the metadata of a graph in memory.

    The adapter is a TOML file or the name of one that ships; None changes nothing. The
    metadata that were written are returned, for a session that opens the file itself.
    An adapter that does not fit the graph raises EvaluationError.
    """
    if adapter is None:
        return {}
    found = Adapter.load(adapter_file(Path(adapter)))
    said = found.metadata(model.metadata_props)
    inputs, outputs = (
        [str(each.name) for each in side]
        for side in (model.graph.inputs, model.graph.outputs)
    )
    # every input that the adapter names must exist
    for name in (*found.feeds, *found.images):
        if name not in inputs:
            raise EvaluationError(
                f"adapter {adapter}: it feeds input {name}; there are"
                f" {', '.join(inputs)}"
            )
    model.metadata_props.update(said)
    # the plan and the recurrent state must be found under the new metadata
    try:
        if found.plan is not None:
            plan_of(found.plan, {}, outputs)
        recurrent_inputs(model)
    except (EvaluationError, GraphError) as error:
        raise EvaluationError(f"adapter {adapter}: {error}") from error
    return said
