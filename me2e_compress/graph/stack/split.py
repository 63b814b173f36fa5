"""Split a graph into the files of the stack that it was joined from."""

from collections.abc import Mapping

import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress.base.errors import GraphError
from me2e_compress.graph.stack.join import End, JoinedStack
from me2e_compress.graph.stack.stack_file import Part

Values = Mapping[str, ir.Value]


def split_stack(stack: JoinedStack, model: ir.Model) -> dict[str, ir.Model]:
    """Return the graph of every part of a joined graph that passes changed.

    A part consists of the nodes between its inputs and outputs, which have the names of
    its file, so that the files can still be run one by one. A constant that two parts
    read is in both. Inputs and outputs that a pass removed are missing, and so is a
    part without outputs. Metadata that were added after joining are in every part.

    Raises:
        GraphError: a part needs a value that another part computes and does not output.
    """
    before, ports = (
        stack.model.metadata_props,
        (*model.graph.inputs, *model.graph.outputs),
    )
    # Metadata that were added after joining go into every part
    added = {k: v for k, v in model.metadata_props.items() if before.get(k) != v}
    ends = {str(value.name): value for value in ports}
    models = dict[str, ir.Model]()
    for part, file in stack.parts.items():
        # Inputs and outputs of the part that passes did not remove
        sources = {name: stack.sources[End(part, name)] for name in file.inputs}
        inputs = {
            name: ends[public]
            for name, source in sources.items()
            if (public := stack.names.get(source, source.name)) in ends
        }
        outputs = {
            name: ends[public]
            for name in file.outputs
            if (public := stack.names[End(part, name)]) in ends
            and name not in file.inputs  # else it is passed on
        }
        if outputs:
            models[part] = _cut(model, file, inputs, outputs)
            models[part].metadata_props.update({**file.model.metadata_props, **added})
    return models


def _cut(model: ir.Model, file: Part, inputs: Values, outputs: Values) -> ir.Model:
    """Copy the nodes between a part's inputs and outputs, with its file's names."""
    borders = list(dict.fromkeys(inputs.values()))
    try:
        graph = ir.convenience.extract(model.graph, borders, list(outputs.values()))
    except ValueError as error:  # it names the inputs that are not among the borders
        names = str(error).rpartition(": ")[2]
        raise GraphError(
            f"{file.name} cannot be cut out again: a pass made it need {names}, which"
            f" {file.path.name} does not take"
        ) from error
    # The extracted weights are in no order
    extracted = graph.initializers
    ordered = [extracted[n] for n in model.graph.initializers if n in extracted]
    extracted.clear()
    for value in ordered:
        extracted.add(value)
    graph.name = file.name
    _rename(graph, file, inputs, outputs)
    # Functions that are called, and domains that are used, alone
    functions = [function.clone() for function in model.functions.values()]
    copy = ir.Model(graph, ir_version=model.ir_version, functions=functions)
    common.RemoveUnusedFunctionsPass()(copy)  # type: ignore[no-untyped-call]
    common.RemoveUnusedOpsetsPass(process_functions=False)(copy)
    return copy


def _rename(graph: ir.Graph, file: Part, inputs: Values, outputs: Values) -> None:
    """Give inputs and outputs the names of the part's file, in its order."""
    inner = [value for node in graph for value in node.outputs]
    others = {str(v.name): v for v in (*graph.initializers.values(), *inner)}

    def name_it(value: ir.Value, name: str) -> None:
        # Rename an inner value of that name
        other = others.get(name)
        if other is not None and other is not value:
            free = f"{name}_"
            while free in others:
                free += "_"
            other.name = free
        value.name = name

    for value, name in zip(graph.outputs, outputs, strict=True):
        name_it(value, name)
    # Where one output feeds two inputs of the part, all is read from the first of them
    copies = dict(zip(dict.fromkeys(inputs.values()), list(graph.inputs), strict=True))
    declared = {str(value.name): value for value in file.model.graph.inputs}
    renamed = list[ir.Value]()
    for name, source in inputs.items():
        value = copies[source]
        if value in renamed:
            own = declared[name]
            value = ir.Value(name=name, type=own.type, shape=own.shape)
        name_it(value, name)
        renamed.append(value)
    graph.inputs[:] = renamed
    ends = {str(value.name): value for value in (*renamed, *graph.outputs)}
    graph.outputs[:] = [ends[name] for name in file.outputs if name in ends]
