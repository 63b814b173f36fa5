"""Run one pass over the frames with a probe on every watched tensor."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress.calibration.probes import Probe
from me2e_compress.errors import GraphError
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay

READINGS = "me2e_readings"
"""Name of the output that the probes write: float32 [tensors x width of the probe]."""

Readings: TypeAlias = npt.NDArray[np.float32]
"""Readings of the probes in one frame: float32 [tensors, width of the probe]."""


class FrameSource(Protocol):
    """Frames with a fingerprint, readable from any index on."""

    @property
    def fingerprint(self) -> str:
        """A digest that changes with the content of the whole recording."""
        ...

    @property
    def places(self) -> Sequence[int]:
        """Indices of these frames in the whole recording."""
        ...

    def __len__(self) -> int:
        """Count the frames."""
        ...

    def __getitem__(self, index: int) -> Frame:
        """Read one frame."""
        ...


class Recording(FrameSource, Protocol):
    """Recorded frames: all of a folder, some of them, or the inputs of a part."""

    @property
    def scenes(self) -> Sequence[int]:
        """Positions among these frames where a scene begins."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Read the frames in order, one in memory at a time."""
        ...


def stream(
    session: Session,
    frames: FrameSource,
    width: int,
    begin: int = 0,
    state: Mapping[str, Array] | None = None,
) -> Iterator[tuple[Readings, dict[str, Array]]]:
    """Run a model with probes over frames; yield each frame's readings and next state.

    ``session`` comes from :func:`probed_session`, ``width`` is that of its probe.
    ``state`` holds the recurrent inputs at frame ``begin`` if no scene starts there.
    """
    rest = (frames[index] for index in range(begin, len(frames)))
    wanted = [READINGS, *session.recurrent.values()]
    for values in replay(session, rest, wanted, state):
        readings = values[READINGS].astype(np.float32).reshape(-1, width)
        yield (
            readings,
            {name: values[answer] for name, answer in session.recurrent.items()},
        )


def probed_session(
    model: ir.Model,
    tensors: Sequence[str],
    probe: Probe,
    *,
    threads: int,
    optimize: bool,
    provider: Provider = CPU,
) -> Session:
    """Open a model with probes, in the memory and nearly the time of the model.

    onnxruntime optimizes the graph with its probes; then the nodes are put into an
    order in which every watched tensor is freed as early as without them. A provider
    that compiles parts of the graph uses an order of its own.
    """
    probed = insert_probes(model, tensors, probe)
    run = partial(Session, threads=threads, frugal=True, provider=provider)
    if not optimize or provider.native != CPU.native:
        return run(probed, optimize=optimize)
    # Write the optimized graph, reorder it, and run it as it is.
    with tempfile.TemporaryDirectory(prefix="me2e-probed-") as folder:
        path = Path(folder) / "optimized.onnx"
        Session(probed, threads=1, rewritten=path, provider=provider)
        rewritten = ir.load(path)
        common.NameFixPass()(rewritten)  # its fusions give one name to two values
        schedule_probes(rewritten)
        scheduled = path.with_name("scheduled.onnx")
        ir.save(rewritten, scheduled)
        return run(scheduled, optimize=False)


def insert_probes(model: ir.Model, tensors: Sequence[str], probe: Probe) -> ir.Model:
    """Return a copy of a graph with a probe right after each tensor's producer.

    The last output of the copy is :data:`READINGS`.
    """
    copy = model.clone()
    known = _values(copy)
    if missing := [name for name in tensors if name not in known]:
        raise GraphError(f"the graph has no tensor {missing[0]}")
    # Measure each tensor right after its producer.
    readings = [
        reading
        for at, name in enumerate(tensors)
        for reading in _watch(copy.graph, known[name], probe, at)
    ]
    # Join all readings into one output.
    joined = ir.node("Concat", readings, {"axis": 0}, name=READINGS)
    joined.outputs[0].name = READINGS
    joined.outputs[0].dtype = ir.DataType.FLOAT
    joined.outputs[0].shape = ir.Shape([len(tensors) * probe.width])
    copy.graph.append(joined)
    copy.graph.outputs.append(joined.outputs[0])
    return copy


def schedule_probes(model: ir.Model) -> None:
    """Move the nodes of every probe to the earliest position, in place.

    onnxruntime runs nodes in the order of the file (``Session(frugal=True)``). Its
    optimizations append new nodes at the end: the conversion from a blocked layout that
    a probe reads would come last, and keep the tensors of a whole backbone in memory.
    """
    # What the model's own outputs need keeps its order; the rest waits for its inputs.
    nodes = list(model.graph)
    own = _needed([v for v in model.graph.outputs if v.name != READINGS])
    waiting = {node: _sources(node) for node in nodes if node not in own}
    order: list[ir.Node] = []

    def ready(value: ir.Value) -> Iterator[ir.Node]:
        for node in dict.fromkeys(value.consumers()):
            if node in waiting and value in waiting[node]:
                waiting[node].discard(value)
                if not waiting[node]:
                    yield node

    def place(first: Sequence[ir.Node]) -> None:
        pending = list(reversed(first))
        while pending:
            node = pending.pop()
            order.append(node)
            pending += [each for out in node.outputs for each in ready(out)]

    # Place nodes without inputs, readers of inputs, then the rest.
    place([node for node in waiting if not waiting[node]])
    for value in model.graph.inputs:
        place(list(ready(value)))
    for node in nodes:
        if node in own:
            place([node])
    placed = set(order)
    order += [node for node in nodes if node not in placed]
    model.graph.remove(nodes)
    model.graph.extend(order)


def _values(model: ir.Model) -> dict[str, ir.Value]:
    made = (value for node in model.graph for value in node.outputs)
    return {str(value.name): value for value in (*model.graph.inputs, *made)}


def _watch(
    where: ir.Graph, value: ir.Value, probe: Probe, at: int
) -> Sequence[ir.Value]:
    nodes: list[ir.Node] = []
    seen = value
    if value.dtype not in (None, ir.DataType.FLOAT):
        nodes.append(ir.node("Cast", [value], {"to": ir.DataType.FLOAT.value}))
        seen = nodes[0].outputs[0]
    # Names tell which tensor a probe measures.
    measuring, readings = probe.read(where, seen, at)
    nodes += measuring
    for order, node in enumerate(nodes):
        node.name = f"{READINGS}/{value.name}/{order}_{node.op_type}"
        node.outputs[0].name = node.name
    # A graph input is measured before anything else runs.
    producer = value.producer()
    if producer is not None:
        where.insert_after(producer, nodes)
    elif len(where):
        where.insert_before(where[0], nodes)
    return readings


def _needed(values: Sequence[ir.Value]) -> set[ir.Node]:
    """Return the nodes that compute some values."""
    found: set[ir.Node] = set()
    pending = [node for value in values if (node := value.producer()) is not None]
    while pending:
        node = pending.pop()
        if node not in found:
            found.add(node)
            pending += [p for v in _reads(node) if (p := v.producer()) is not None]
    return found


def _sources(node: ir.Node) -> set[ir.Value]:
    """Return the values that a node needs before it can run."""
    return {v for v in _reads(node) if v.producer() is not None or v.is_graph_input()}


def _reads(node: ir.Node) -> Iterator[ir.Value]:
    """Yield the inputs of a node and those that its bodies read."""
    for value in node.inputs:
        if value is not None:
            yield value
    for attribute in node.attributes.values():
        for body in _bodies(attribute):
            for inner in body.all_nodes():
                for value in inner.inputs:
                    if value is not None and value.graph is node.graph:
                        yield value


def _bodies(attribute: ir.Attr) -> Sequence[ir.Graph]:
    if attribute.type == ir.AttributeType.GRAPH:
        return (attribute.as_graph(),)
    if attribute.type == ir.AttributeType.GRAPHS:
        return tuple(attribute.as_graphs())
    return ()
