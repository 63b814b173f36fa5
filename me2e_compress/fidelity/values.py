"""The values that a graph computes of its inputs, each in a sketch."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.fidelity.sketches import WIDTH, Sketch, Sketches
from me2e_compress.graph.nodes import VIEWS, constant_values, is_standard
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.graph.shapes import static_shape
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.probing import READINGS, insert_probes, with_shapes
from me2e_compress.runtime.providers import Provider
from me2e_compress.runtime.session import Session, detached

Fed: TypeAlias = Sequence[Mapping[str, Array]]
"""What a graph was fed, state included, frame by frame."""


class Values:
    """The values of a graph that depend on its inputs, and their sketches.

    A view (Reshape, Squeeze, ...) shares the sketch of what it reads.

    Args:
        model: the graph; a copy is kept whose inputs are as large as the first frame.
        frames: what it will run on.
    """

    def __init__(self, model: ir.Model, frames: Sequence[Frame]) -> None:
        self.model = _sized(model, frames)
        constant = constant_values(self.model)
        self.by_name: dict[str, ir.Value] = {}
        self.source: dict[str, str] = {}
        for node in self.model.graph:
            for value in node.outputs:
                if value.name and value not in constant and _can_differ(value):
                    self.by_name[value.name] = value
                    self.source[value.name] = self._source(node, value.name)
        self._row: dict[str, int] = {}
        self.sketches: Sketches = np.empty((0, 0, WIDTH))

    @property
    def watched(self) -> tuple[str, ...]:
        """The values that have a sketch of their own."""
        return tuple(dict.fromkeys(self.source[name] for name in self.by_name))

    def _source(self, node: ir.Node, name: str) -> str:
        data = node.inputs[0] if node.inputs else None
        is_view = is_standard(node) and node.op_type in VIEWS and data is not None
        return self.source.get(data.name or "", name) if is_view and data else name

    def sketch_of(self, name: str) -> Sketches:
        """Return the sketches of one value: float64 [frames, 33]."""
        return self.sketches[:, self._row[self.source[name]]]

    def run(
        self, frames: Sequence[Frame], provider: Provider, fed: Fed | None = None
    ) -> Fed:
        """Run the graph once over the frames and keep the sketches; return its feeds.

        ``fed`` is what another graph was fed: its state then replaces this graph's own,
        so that a difference in one frame does not come back with the next. Shapes that
        are not what the graph declares are measured.
        """
        if not self.watched:
            raise EvaluationError("no value of the graph depends on its inputs")
        try:
            return self._run(frames, provider, fed)
        except GraphError:
            self.measure_shapes(frames, provider, self.by_name)
            return self._run(frames, provider, fed)

    def _run(self, frames: Sequence[Frame], provider: Provider, fed: Fed | None) -> Fed:
        # measured shapes may be those of tensors without elements
        self.by_name = {k: v for k, v in self.by_name.items() if _can_differ(v)}
        watched = self.watched
        self._row = {name: at for at, name in enumerate(watched)}
        probed = insert_probes(self.model, watched, Sketch())
        session = Session(
            probed, optimize=False, frugal=True, release=True, provider=provider
        )
        feeds, readings = list[Mapping[str, Array]](), list[Array]()
        for given, found in fed_forward(session, frames, [READINGS], fed):
            feeds.append(given)
            readings.append(found[READINGS])
        stacked = np.stack(readings).astype(np.float64)
        self.sketches = stacked.reshape(len(frames), len(watched), WIDTH)
        return feeds

    def unshaped(self) -> list[str]:
        """List the values whose shape is not known."""
        return [
            name for name, each in self.by_name.items() if static_shape(each) is None
        ]

    def measure_shapes(
        self, frames: Sequence[Frame], provider: Provider, names: Iterable[str]
    ) -> None:
        """Run the graph for the shapes of values.

        Those that change from frame to frame are not known then.
        """
        unknown = list(names)
        if not unknown:
            return
        shaped = with_shapes(self.model, unknown)
        session = Session(shaped, optimize=False, release=True, provider=provider)
        outputs = [str(each.name) for each in shaped.graph.outputs[-len(unknown) :]]
        seen: dict[str, set[tuple[int, ...]]] = {name: set() for name in unknown}
        for _, found in fed_forward(session, frames, outputs):
            for name, shape in zip(unknown, outputs, strict=True):
                seen[name].add(tuple(found[shape].tolist()))
        for name, shapes in seen.items():
            known = ir.Shape(next(iter(shapes))) if len(shapes) == 1 else None
            self.by_name[name].shape = known

    def take_shapes(self, other: "Values") -> None:
        """Take unknown shapes from namesakes of another graph."""
        for name, value in self.by_name.items():
            theirs = other.by_name.get(name)
            if theirs is not None and static_shape(value) is None:
                value.shape = theirs.shape


def fed_forward(
    session: Session,
    frames: Sequence[Frame],
    outputs: Sequence[str],
    fed: Fed | None = None,
) -> Iterator[tuple[Mapping[str, Array], dict[str, Array]]]:
    """Run a graph over frames; yield what each was fed, and these outputs.

    Its state is fed forward as :func:`me2e_compress.runtime.session.replay` does, or is
    that of ``fed``.
    """
    memory: Mapping[str, Array] = {}
    wanted = [*outputs, *session.recurrent.values()]
    for at, frame in enumerate(frames):
        if frame.starts_scene or not at:
            memory = session.first_state(frame.arrays)
        given = {**frame.arrays, **memory} if fed is None else fed[at]
        found = detached(session.run(given, list(dict.fromkeys(wanted))))
        yield given, found
        memory = {name: found[out] for name, out in session.recurrent.items()}


def first_state(model: ir.Model, frame: Frame) -> dict[str, Array]:
    """Return the recurrent inputs of a graph where a scene begins; zeros by default.

    Raises:
        GraphError: one that the frame lacks has an open shape.
    """
    inputs = {value.name: value for value in model.graph.inputs}
    state = dict[str, Array]()
    for name in recurrent_inputs(model):
        value, shape = inputs[name], static_shape(inputs[name])
        if name in frame.arrays:
            state[name] = frame.arrays[name]
        elif shape is None or value.dtype is None:
            raise GraphError(
                f"recurrent input {name} of open shape needs a first value"
            )
        else:
            state[name] = np.zeros(shape, value.dtype.numpy())
    return state


def _sized(model: ir.Model, frames: Sequence[Frame]) -> ir.Model:
    """Copy a graph, its inputs as large as they are on all frames, shapes inferred."""
    copy = model.clone()
    for value in copy.graph.inputs:
        shapes = {
            frame.arrays[name].shape
            for frame in frames
            if (name := value.name or "") in frame.arrays
        }
        if len(shapes) == 1:
            value.shape = ir.Shape(next(iter(shapes)))
    graph.infer_shapes(copy)
    return copy


def _can_differ(value: ir.Value) -> bool:
    """Return whether a value is a tensor of numbers, of any at all."""
    kind = value.type
    numeric = isinstance(kind, ir.TensorType) and kind.dtype != ir.DataType.STRING
    return numeric and 0 not in (static_shape(value) or ())
