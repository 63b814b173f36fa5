"""Values that replace those whose nodes are removed."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.means import load_means, token_means
from me2e_compress.display import counted
from me2e_compress.errors import FramesError, PreconditionError
from me2e_compress.graph import provenance, rewrite
from me2e_compress.passes.base import Context
from me2e_compress.passes.parts import Part, fit, listed, stretched
from me2e_compress.runtime.frames import Array

_INTEGERS = (ir.DataType.INT64, ir.DataType.INT32, ir.DataType.BOOL)


def module_of(value: ir.Value) -> str:
    """Return the module that makes a value; empty for inputs and initializers."""
    producer = value.producer()
    return "" if producer is None else provenance.module_of(producer)


def result_of(model: ir.Model, part: Part, like: ir.Value | None = None) -> ir.Value:
    """Return the last value that leaves a part, with ``like`` the last that fits it.

    A decoder returns its queries and, last, the reference points it refined. Raises
    PreconditionError if there is none.
    """
    found = part.exits(model)
    if like is None and found:
        return found[-1]
    if like is None or not found:
        raise PreconditionError(f"no value leaves a scope {part.name} in this graph")
    # Prefer the best fit, then the last value
    ranked = [(fit(value, like), index) for index, value in enumerate(found)]
    best, index = max(ranked)
    if not best:
        raise PreconditionError(
            f"nothing that leaves {part.name} fits {like.name} {like.shape}:"
            f" {listed(found)}"
        )
    return found[index]


def is_shape_arithmetic(value: ir.Value) -> bool:
    """Return whether integers come only from shapes and constants, not from data."""
    queue, seen = [value], {value}
    while queue:
        current = queue.pop()
        if current.is_graph_input() or current.dtype not in _INTEGERS:
            return False
        producer = current.producer()
        if producer is None or producer.op_type in ("Shape", "Size"):
            continue
        for each in producer.inputs:
            if each is not None and each not in seen:
                seen.add(each)
                queue.append(each)
    return True


def replace_readers(old: ir.Value, new: ir.Value) -> None:
    """Replace a value in the nodes that read it, but not as a graph output."""
    maker = new.producer()
    for node, index in tuple(old.uses()):
        if node is not maker:
            node.replace_input_with(index, new)


def constant_like(where: ir.Graph, value: ir.Value, array: Array) -> ir.Value:
    """Add a constant in place of a value of the same type and shape."""
    shape, dtype = layout_of(value)
    if array.dtype != dtype or array.shape != shape:
        raise PreconditionError(
            f"a constant {array.dtype} {list(array.shape)} cannot stand for"
            f" {value.name}, which is {dtype} {list(shape)}"
        )
    return rewrite.add_constant(where, array, f"{value.name}_mean")


def layout_of(value: ir.Value) -> tuple[tuple[int, ...], np.dtype[np.generic]]:
    """Return the shape and type of a substitute; shape arithmetic has none."""
    if is_shape_arithmetic(value):
        raise PreconditionError(
            f"{value.name} is arithmetic on shapes, which no module owns: run"
            " fold-constants first"
        )
    shape = graph.static_shape(value)
    if shape is None or value.dtype is None:
        raise PreconditionError(
            f"{value.name} has shape {value.shape}: zeros or a mean need a static one,"
            " run fold-constants first"
        )
    return shape, value.dtype.numpy()


def zeros_like(
    where: ir.Graph, value: ir.Value, readers: Sequence[ir.Node], by: str
) -> ir.Value:
    """Add zeros of a value's shape and type, in a few bytes of any size."""
    shape, dtype = layout_of(value)
    zero = ir.tensor(np.zeros(1, dtype), name="zero")
    node = ir.node("ConstantOfShape", [_size(where, shape, value)], {"value": zero})
    provenance.inherit(node, readers, by=by)
    return finished(where, node, shape, value, f"{value.name}_zeros")


def shaped_like(
    where: ir.Graph,
    new: ir.Value,
    old: ir.Value,
    readers: Sequence[ir.Node],
    by: str,
) -> ir.Value:
    """Give ``new`` the shape of ``old``: add ones, then repeat along axes of size 1.

    It must fit, see :func:`~me2e_compress.passes.parts.fit`.
    """
    have, want = graph.static_shape(new), graph.static_shape(old)
    padded = have and want and stretched(have, want)
    if have == want or not padded or not want:
        return new
    shaped = reshaped(where, new, padded, readers, by)
    if padded == want:
        return shaped
    # Repeat along axes of size 1
    node = ir.node("Expand", [shaped, _size(where, want, old)])
    provenance.inherit(node, readers, by=by)
    return finished(where, node, want, new, f"{new.name}_repeated")


def reshaped(
    where: ir.Graph,
    value: ir.Value,
    shape: tuple[int, ...],
    readers: Sequence[ir.Node],
    by: str,
) -> ir.Value:
    """Reshape a value for some readers, unless it has that shape."""
    if graph.static_shape(value) == shape:
        return value
    node = ir.node("Reshape", [value, _size(where, shape, value)])
    provenance.inherit(node, readers, by=by)
    return finished(where, node, shape, value, f"{value.name}_reshaped")


def _size(where: ir.Graph, shape: tuple[int, ...], of: ir.Value) -> ir.Value:
    return rewrite.add_constant(where, np.array(shape, np.int64), f"{of.name}_shape")


def finished(
    where: ir.Graph,
    node: ir.Node,
    shape: tuple[int, ...],
    like: ir.Value,
    name: str,
) -> ir.Value:
    """Name a new node and its only output, append it, and return the output."""
    unique = rewrite.fresh_name(name, rewrite.value_names(where))
    node.name = unique
    output = node.outputs[0]
    output.name, output.shape, output.type = unique, ir.Shape(shape), like.type
    where.append(node)
    return output


def means_of(
    model: ir.Model,
    values: Sequence[ir.Value],
    context: Context,
    file: Path | None,
) -> tuple[dict[str, Array], str]:
    """Read means by value name from a file, or measure them; also name their source.

    Raises:
        FramesError: neither frames nor a file, or they are of another graph.
    """
    for value in values:
        layout_of(value)
    names = [str(value.name) for value in values]
    if file is not None:
        return load_means(file, names), f"its mean in {file}"
    frames = context.frames
    if frames is None:
        raise FramesError(
            "fill=means needs recorded frames (--frames) or a file (means=FILE.npz):"
            " a mean is never made up"
        )
    count = counted(len(frames), "frame")
    means = token_means(model, frames, names, provider=context.provider)
    return means, f"its mean over {count}"
