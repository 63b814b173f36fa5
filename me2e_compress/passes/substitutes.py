"""What can be read in the place of a value whose makers are removed."""

import math
from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress import graph, rewrite
from me2e_compress.errors import PreconditionError
from me2e_compress.graph import provenance
from me2e_compress.modules import PathGlob, exits, scope_of
from me2e_compress.runtime.frames import Array

_INTEGERS = (ir.DataType.INT64, ir.DataType.INT32, ir.DataType.BOOL)


def module_of(value: ir.Value) -> str:
    """Return the module that makes a value; empty for inputs and initializers."""
    producer = value.producer()
    return "" if producer is None else provenance.module_of(producer)


def within(node: ir.Node, scope: str) -> bool:
    """Return whether a node was made in a scope, e.g. ``*.lane_encoder``."""
    path = tuple(part for part in scope_of(node).split(".") if part)
    return PathGlob(scope).reach(path) is not None


def result_of(model: ir.Model, scope: str, like: ir.Value | None = None) -> ir.Value:
    """Return what a scope returns: the last value that leaves it.

    A decoder returns its queries and, last, the reference points it refined; so the
    last value *that fits* is taken where it is known what it must fit.

    Args:
        model: the graph, its nodes still scoped.
        scope: pattern as in a module map, e.g. ``*.motion_decoder``.
        like: what it is to substitute for: same type, same shape up to dimensions of
            size 1.

    Raises:
        PreconditionError: nothing leaves such a scope, or nothing that fits.
    """
    leaving = exits(model, scope)
    fitting = [value for value in leaving if like is None or _fits(value, like)]
    if fitting:
        return fitting[-1]
    if like is None or not leaving:
        raise PreconditionError(f"no value leaves a scope {scope} in this graph")
    found = ", ".join(f"{value.name} {value.shape}" for value in leaving)
    raise PreconditionError(
        f"nothing that leaves {scope} fits {like.name} {like.shape}: {found}"
    )


def _fits(value: ir.Value, like: ir.Value) -> bool:
    have, want = graph.static_shape(value), graph.static_shape(like)
    if have is None or want is None or value.dtype != like.dtype:
        return False
    return have == want or _bare(have) == _bare(want)


def depends(value: ir.Value, on: ir.Value) -> bool:
    """Return whether a value is computed from another (or is it)."""
    queue, seen = [value], {value}
    while queue:
        current = queue.pop()
        if current is on:
            return True
        producer = current.producer()
        for each in () if producer is None else producer.inputs:
            if each is not None and each not in seen:
                seen.add(each)
                queue.append(each)
    return False


def is_shape_arithmetic(value: ir.Value) -> bool:
    """Return whether integers come from shapes and constants alone, not from data."""
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
    """Replace a value in the nodes that read it; graph outputs keep theirs."""
    maker = new.producer()
    for node, index in tuple(old.uses()):
        if node is not maker:
            node.replace_input_with(index, new)


def constant_like(where: ir.Graph, value: ir.Value, array: Array) -> ir.Value:
    """Make a constant that stands for a value.

    Args:
        where: the graph that gets it.
        value: what it stands for.
        array: what it is.

    Raises:
        PreconditionError: the array has another type or shape than the value, or the
            value is itself a shape.
    """
    shape, dtype = layout_of(value)
    if array.dtype != dtype or array.shape != shape:
        raise PreconditionError(
            f"a constant {array.dtype} {list(array.shape)} cannot stand for"
            f" {value.name}, which is {dtype} {list(shape)}"
        )
    return rewrite.add_constant(where, array, f"{value.name}_mean")


def layout_of(value: ir.Value) -> tuple[tuple[int, ...], np.dtype[np.generic]]:
    """Return the shape and the type that a substitute must have.

    Raises:
        PreconditionError: the shape is not static, or the value is itself a shape.
    """
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
    """Make zeros of a value's shape and type: a few bytes, whatever the size.

    Args:
        where: the graph that gets the node.
        value: what the zeros stand for.
        readers: the nodes that will read them, whose heir the new node is.
        by: name of the pass.

    Raises:
        PreconditionError: the shape is not static, or the value is itself a shape.
    """
    shape, dtype = layout_of(value)
    size = rewrite.add_constant(where, np.array(shape, np.int64), f"{value.name}_shape")
    zero = ir.tensor(np.zeros(1, dtype), name="zero")
    node = ir.node("ConstantOfShape", [size], {"value": zero})
    provenance.inherit(node, readers, by=by)
    return _finished(where, node, value, f"{value.name}_zeros")


def shaped_like(
    where: ir.Graph,
    new: ir.Value,
    old: ir.Value,
    readers: Sequence[ir.Node],
    by: str,
) -> ir.Value:
    """Reshape a value to another's shape; they differ in dimensions of size 1 only."""
    want = graph.static_shape(old)
    if graph.static_shape(new) == want:
        return new
    size = rewrite.add_constant(where, np.array(want, np.int64), f"{old.name}_shape")
    node = ir.node("Reshape", [new, size])
    provenance.inherit(node, readers, by=by)
    return _finished(where, node, old, f"{old.name}_substitute")


def _bare(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Drop the ones: a reorder that moves only those moves no element."""
    if math.prod(shape) == 0:
        return shape
    return tuple(size for size in shape if size != 1)


def _finished(where: ir.Graph, node: ir.Node, like: ir.Value, name: str) -> ir.Value:
    node.name = name
    output = node.outputs[0]
    output.name, output.shape, output.type = name, like.shape, like.type
    where.append(node)
    return output
