"""The few moves that every rewrite is made of."""

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress.graph.names import fresh_name, value_names


def array_of(value: ir.Value | None) -> npt.NDArray[np.generic] | None:
    """Give the array of an initializer or Constant; None if the value is computed."""
    if value is None or value.is_graph_input():
        return None
    if value.const_value is not None and value.is_initializer():
        return value.const_value.numpy()
    if value.producer() is None:
        return None
    tensor = ir.convenience.get_const_tensor(value)
    return None if tensor is None else tensor.numpy()


def add_constant(
    graph: ir.Graph,
    array: npt.NDArray[np.generic],
    name: str,
    names: set[str] | None = None,
) -> ir.Value:
    """Register an initializer under this name, or ``name_1``, ... where it is taken.

    Args:
        graph: where.
        array: what it holds.
        name: what to call it, if that is free.
        names: those that are taken, the new one is entered; None to look at the whole
            graph, which whoever adds thousands had better do once.
    """
    unique = fresh_name(name, value_names(graph) if names is None else names)
    flat = np.ascontiguousarray(array).reshape(array.shape)
    tensor = ir.tensor(flat, name=unique)
    value = ir.Value(
        name=unique,
        shape=ir.Shape(array.shape),
        type=ir.TensorType(tensor.dtype),
        const_value=tensor,
    )
    graph.register_initializer(value)
    return value


def replace_value(old: ir.Value, new: ir.Value) -> None:
    """Let every reader of one value read another; a graph output keeps its name.

    Where ``old`` is a graph output, ``new`` takes its place and its name, so that the
    interface stays as it was. ``new`` must not itself be an input, an initializer or
    another output then: callers check with :func:`can_replace`.
    """
    if old.is_graph_output():
        graph = old.graph
        name, shape, kind = old.name, old.shape, old.type
        old.replace_all_uses_with(new, replace_graph_outputs=True)
        old.name = f"{name}_replaced" if graph is not None else name
        new.name, new.shape, new.type = name, shape, kind
    else:
        old.replace_all_uses_with(new)


def can_replace(old: ir.Value, new: ir.Value) -> bool:
    """Say whether ``new`` may stand for ``old`` without touching the interface."""
    if not old.is_graph_output():
        return True
    return not (
        new.is_graph_output()
        or new.is_graph_input()
        or new.is_initializer()
        or new.graph is not old.graph
    )


def sweep(model: ir.Model) -> None:
    """Drop the nodes, weights and functions nothing reads any more."""
    common.RemoveUnusedNodesPass()(model)
    common.RemoveUnusedFunctionsPass()(model)  # type: ignore[no-untyped-call]


def sort(model: ir.Model) -> None:
    """Put nodes into a stable topological order."""
    model.graph.sort()
