"""Hold the body of every fused operator against its kernel, once.

Sessions run a fused node by its compiled kernel, so that the body which a file carries
for other runtimes is never run here: it is opened alone, on what a call of it reads.
"""

import dataclasses
import math
from collections.abc import Iterator

import onnx_ir as ir

from me2e_compress.errors import FramesError, GraphError
from me2e_compress.manager.output_errors import TOLERANCES, relative
from me2e_compress.manager.pieces import show
from me2e_compress.manager.verification_inputs import VerificationInputs
from me2e_compress.runtime.session import run_once

_DOMAIN = "body"
"""Where a body lies to be run: no kernel is registered for this domain."""


def body_errors(
    before: ir.Model, after: ir.Model, inputs: VerificationInputs
) -> Iterator[tuple[str, float, float]]:
    """Run the bodies that passes added, each on what its first call reads.

    Args:
        before: the graph before the passes.
        after: the graph after them, shapes inferred.
        inputs: the first frame is run.

    Yields:
        An operator, max|a-b|/max|a| of what kernel and body give, which is infinite for
        a body that does not run, and how large that may be, by the dtype.

    Raises:
        GraphError: onnxruntime cannot run the graph.
    """
    added = after.functions.keys() - before.functions.keys()
    calls: dict[ir.OperatorIdentifier, ir.Node] = {}
    for node in after.graph:
        if node.op_identifier() in added:
            calls.setdefault(node.op_identifier(), node)
    if not calls:
        return
    # Without the functions every call runs as it did before: by its kernel
    bare = after.clone()
    for identifier in added:
        del bare.functions[identifier]
    made = {value.name: value for node in bare.graph for value in node.outputs}
    for node in calls.values():
        call = made[node.outputs[0].name].producer()
        assert call is not None
        for place, value in enumerate(call.inputs):
            if value is not None:
                show(bare, value, _name(node, place))
        show(bare, call.outputs[0], _name(node, None))
    first = dataclasses.replace(inputs, frames=inputs.frames[:1])
    (values,) = first.run(bare)
    for identifier, node in calls.items():
        body = _alone(node, after.functions[identifier], after)
        reads = {
            str(value.name): values[_name(node, place)]
            for place, value in enumerate(node.inputs)
            if value is not None
        }
        by_kernel = values[_name(node, None)]
        try:
            error = relative(by_kernel, run_once(body, reads)["answer"])
        except (FramesError, GraphError):
            error = math.inf
        yield node.op_type, error, TOLERANCES.get(by_kernel.dtype.name, 0.0)


def _name(node: ir.Node, place: int | None) -> str:
    return f"call/{node.outputs[0].name}/{'answer' if place is None else place}"


def _alone(node: ir.Node, function: ir.Function, model: ir.Model) -> ir.Model:
    """Return a graph of one call, whose body no kernel stands in for."""
    reads = [
        value and ir.Value(name=value.name, type=value.type, shape=value.shape)
        for value in node.inputs
    ]
    function = function.clone()
    function.domain = _DOMAIN
    attributes = list(node.attributes.values())
    call = ir.Node(
        _DOMAIN, node.op_type, reads, attributes, overload=node.overload, name="call"
    )
    call.outputs[0].name, call.outputs[0].type = "answer", node.outputs[0].type
    body = ir.Graph(
        list({value.name: value for value in reads if value is not None}.values()),
        call.outputs,
        nodes=[call],
        opset_imports={**model.opset_imports, _DOMAIN: 1},
    )
    return ir.Model(body, ir_version=model.ir_version, functions=[function])
