"""Evaluate constant expressions with onnxruntime: all at once, or one by one."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
import onnxruntime

from me2e_compress.graph import array_of
from me2e_compress.graph.rewrite import Array
from me2e_compress.runtime.opening import REFUSALS

SILENT = 4
"""onnxruntime's log level "fatal": the notes report what cannot be evaluated."""


@dataclasses.dataclass(eq=False)
class Expression:
    """Equal nodes of constants; each input is replaced by its first equal."""

    nodes: list[ir.Node]
    inputs: tuple[ir.Value | None, ...]


@dataclasses.dataclass
class Knowledge:
    """What is known about the values of one graph.

    ``first`` maps a value that is computed twice to the first value that equals it.
    """

    arrays: dict[ir.Value, Array]
    expressions: list[Expression]
    maker: dict[ir.Value, Expression]
    first: dict[ir.Value, ir.Value]

    def canonical(self, value: ir.Value) -> ir.Value:
        """Return the first value equal to this one."""
        return self.first.get(value, value)


def evaluate(
    values: Sequence[ir.Value], known: Knowledge, opset: int
) -> tuple[dict[ir.Value, Array], list[ir.Node]]:
    """Return the computed values, and the nodes that the runtime refused.

    Nodes run in one session, or each in its own if that fails.
    """
    needed = _needed(values, known)
    if not needed:
        return {}, []
    try:
        return run(needed, list(values), known.arrays, opset), []
    except REFUSALS:
        return _one_by_one(needed, values, known, opset)


def _one_by_one(
    needed: Sequence[Expression],
    values: Sequence[ir.Value],
    known: Knowledge,
    opset: int,
) -> tuple[dict[ir.Value, Array], list[ir.Node]]:
    done: dict[ir.Value, Any] = dict(known.arrays)
    refused: list[ir.Node] = []
    for one in needed:
        outputs = [value for value in one.nodes[0].outputs if value.name]
        inputs = [value for value in one.inputs if value is not None]
        # Skip nodes whose inputs could not be computed
        if any(value in known.maker and value not in done for value in inputs):
            continue
        try:
            done.update(run([one], outputs, done, opset))
        except REFUSALS:
            refused.extend(one.nodes)
    found = {value: done[value] for value in values if value in done}
    return found, refused


def _needed(values: Sequence[ir.Value], known: Knowledge) -> list[Expression]:
    wanted = {known.maker[value] for value in values}
    for one in reversed(known.expressions):
        if one in wanted:
            wanted.update(
                known.maker[value]
                for value in one.inputs
                if value in known.maker and value not in known.arrays
            )
    return [one for one in known.expressions if one in wanted]


def run(
    expressions: Sequence[Expression],
    values: Sequence[ir.Value],
    arrays: Mapping[ir.Value, Any],
    opset: int,
) -> dict[ir.Value, Any]:
    """Compute values of expressions, as written, in one session of onnxruntime."""
    names: dict[ir.Value, str] = {}
    feeds: dict[str, Any] = {}
    nodes = [_node(one, names, feeds, arrays) for one in expressions]
    # Write the expressions as a model of their own
    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            nodes,
            "constants",
            [_port(name, array) for name, array in feeds.items()],
            [onnx.ValueInfoProto(name=names[value]) for value in values],
        ),
        opset_imports=[onnx.helper.make_opsetid("", opset)],
        ir_version=8,
    )
    # No optimization: run exactly the nodes as written
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = (
        onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    )
    options.intra_op_num_threads = 1
    options.enable_cpu_mem_arena = False  # it would live as long as a constant does
    options.log_severity_level = SILENT
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    run = onnxruntime.RunOptions()
    run.log_severity_level = SILENT
    outputs = session.run([names[value] for value in values], feeds, run)
    return dict(zip(values, outputs, strict=True))


def _node(
    one: Expression,
    names: dict[ir.Value, str],
    feeds: dict[str, Any],
    arrays: Mapping[ir.Value, Any],
) -> onnx.NodeProto:
    proto = ir.serde.serialize_node(one.nodes[0])
    del proto.input[:], proto.output[:], proto.metadata_props[:]
    for value in one.inputs:
        if value is None:
            proto.input.append("")
            continue
        if value not in names:
            names[value] = f"v{len(names)}"
            array = arrays.get(value)
            feeds[names[value]] = array_of(value) if array is None else array
        proto.input.append(names[value])
    for value in one.nodes[0].outputs:
        if value.name:
            names[value] = f"v{len(names)}"
        proto.output.append(names[value] if value.name else "")
    return proto


def _port(name: str, array: Array) -> onnx.ValueInfoProto:
    kind = onnx.helper.np_dtype_to_tensor_dtype(np.dtype(array.dtype))
    return onnx.helper.make_tensor_value_info(name, kind, array.shape)
