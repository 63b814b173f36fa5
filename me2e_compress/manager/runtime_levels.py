"""Where onnxruntime's own optimizations change what a graph gives.

It rewrites a graph when it opens it, at levels that do more and more; a rewrite that is
wrong for a graph (there were some in every release) is not the fault of a pass.
"""

from collections.abc import Iterable, Iterator, Mapping
from functools import partial

import onnx_ir as ir

from me2e_compress.errors import FramesError, GraphError
from me2e_compress.graph.nodes import is_read, makers_of
from me2e_compress.graph.rewrite import sweep
from me2e_compress.manager.verification_inputs import (
    VerificationInputs,
    errors,
    relative,
)
from me2e_compress.runtime.session import Level, Session

LEVELS: tuple[Level, ...] = ("basic", "extended", "layout", "all")


def disagreements(
    what: str,
    model: ir.Model,
    outputs: Iterable[str],
    allowed: Mapping[str, float],
    inputs: VerificationInputs,
) -> Iterator[str]:
    """Say where onnxruntime answers a graph otherwise when it optimizes it.

    Args:
        what: how a sentence calls the graph.
        model: the graph.
        outputs: those that are looked at.
        allowed: by how much of its largest value an output may differ.
        inputs: what the graph is run on.

    Yields:
        A sentence for each output: the first level, and the first node.
    """
    plain, waiting = list(inputs.run(model, "none")), list(outputs)
    for level in LEVELS:
        try:
            gaps = errors(plain, inputs.run(model, level))
        except GraphError:
            yield f"onnxruntime cannot run the graph {what} at its level {level}"
            return
        for name in [name for name in waiting if gaps[name] > allowed[name]]:
            waiting.remove(name)
            node = first_node(model, name, level, allowed[name], inputs)
            where = "" if node is None else f", from node {node.name} ({node.op_type})"
            yield (
                f"onnxruntime gives another {name} of the graph {what} at its level"
                f" {level} than without optimizations (off by {gaps[name]:.1e} of its"
                f" largest){where}; judged without them"
            )


def first_node(
    model: ir.Model,
    output: str,
    level: Level,
    allowed: float,
    inputs: VerificationInputs,
) -> ir.Node | None:
    """Find the first node behind which a level differs, in log2 trials.

    None where the difference does not show on one frame, or not of this output alone.
    """
    frame = inputs.frames[0]
    session = Session(model, optimize="none", provider=inputs.provider)
    feeds = {**frame.arrays, **session.first_state(frame.arrays)}
    makers = makers_of(v for v in model.graph.outputs if v.name == output)
    behind = [node for node in model.graph if node in makers]

    def differs(node: ir.Node) -> bool:
        opened = partial(Session, _up_to(model, node), provider=inputs.provider)
        try:
            plain = opened(optimize="none").run(feeds)
            optimized = opened(optimize=level).run(feeds)
        except (GraphError, FramesError):
            return False  # an output of a type that cannot be compared, say
        return any(relative(plain[n], optimized[n]) > allowed for n in plain)

    if not behind or not differs(behind[-1]):
        return None
    good, bad = -1, len(behind) - 1
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (good, middle) if differs(behind[middle]) else (middle, bad)
    return behind[bad]


def _up_to(model: ir.Model, node: ir.Node) -> ir.Model:
    """Cut a graph off behind a node."""
    part = model.clone()
    part.metadata_props.clear()  # it speaks of outputs that go
    names = {value.name for value in node.outputs if value.name and is_read(value)}
    made = {value.name: value for each in part.graph for value in each.outputs}
    part.graph.outputs.clear()
    part.graph.outputs.extend(made[name] for name in sorted(filter(None, names)))
    sweep(part)
    return part
