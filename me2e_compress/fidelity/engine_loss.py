"""What an engine lost, and the first module after which a graph differs.

The loss is split into quantization and compilation, output by output. For the first
module, both graphs run on one frame, with every tensor that one module passes to
another as one more output, and those that both name alike are compared, whole.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import EvaluationError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.engine_dump import EngineDump
from me2e_compress.fidelity import ALIVE, SQNR_FLOOR_DB
from me2e_compress.fidelity.compare import Tally
from me2e_compress.fidelity.liveness import OutputTally
from me2e_compress.graph.nodes import constant_values, nodes_of, reads_of
from me2e_compress.graph.provenance import module_of
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import DTYPES, Session, detached, feed_forward

Arrays: TypeAlias = Mapping[str, Array]
Frames: TypeAlias = CalibrationSet | Sequence[Frame]
Dump: TypeAlias = EngineDump | Sequence[Arrays]


class EngineRun:
    """What an engine answered, and what a graph answers with the engine's state.

    ``session`` runs the graph that the engine was built from, ``dump`` has the engine's
    answers by frame, ``names`` are the outputs that both have.
    """

    def __init__(self, session: Session, frames: Frames, dump: Dump) -> None:
        self.session, self.frames, self.dump = session, frames, dump
        self.names = [name for name in session.outputs if name in dump[0]]

    def __len__(self) -> int:
        return len(self.frames)

    def run_graph(
        self, session: Session, names: Sequence[str]
    ) -> Iterator[tuple[Arrays, Arrays]]:
        """Run a graph over all frames; yield its inputs and its outputs ``names``."""
        # State is that of the dump, or of this run's last frame where the dump lacks
        # it, and is reset where a scene begins
        own = [name for name in session.recurrent.values() if name not in self.dump[0]]
        computed = list(dict.fromkeys([*names, *own]))
        state = dict[str, Array]()
        for index in range(len(self)):
            frame = self.frames[index]
            if index == 0 or frame.starts_scene:
                state = session.first_state(frame.arrays)
            inputs = {**frame.arrays, **state}
            answers = session.run(inputs, computed)
            yield inputs, {name: answers[name] for name in names}
            after = {**answers, **self.dump[index]}
            # A copy: the session may write its next answers into the same memory
            state = {
                name: np.array(after[output], DTYPES[session.inputs[name].type])
                for name, output in session.recurrent.items()
            }

    def check(self, index: int, truth: Arrays) -> None:
        """Check the engine's answers to a frame against those of its graph.

        Raises:
            EvaluationError: an output has another shape, or is not finite.
        """
        for name in self.names:
            value, shape = self.dump[index][name], truth[name].shape
            if value.shape != shape:
                raise EvaluationError(
                    f"output {name} is {list(value.shape)} in the dump at frame"
                    f" {index}, {list(shape)} in the graph"
                )
            if value.dtype.kind == "f" and not np.isfinite(value).all():
                kind = "NaN" if np.isnan(value).any() else "infinite"
                at = np.argwhere(~np.isfinite(value))[0].tolist()
                raise EvaluationError(
                    f"output {name} of the dump is {kind} at frame {index}, {at}"
                )


@dataclasses.dataclass(frozen=True)
class OutputLoss:
    """What one output lost, in dB of SQNR over all frames; infinite where nothing.

    It is -infinity where the graph or its source is not finite.

    Attributes:
        quantization_db: The graph against its float source; None without one.
        compilation_db: The engine, and the host that feeds it, against the graph.
        all_db: The engine against the float source, or against the graph without one.
        moves: Standard deviation of the engine's answers over the frames, as a share of
            the source's, or the graph's without one; None if those rest.
        dead: What is wrong if it moves hardly at all; empty otherwise.
    """

    name: str
    quantization_db: float | None
    compilation_db: float
    all_db: float
    moves: float | None
    dead: str


def split_losses(
    run: EngineRun,
    source: Session | None,
    alive: float = ALIVE,
    on_frame: Callable[[int], None] = lambda index: None,
) -> tuple[OutputLoss, ...]:
    """Run both graphs side by side over the frames, and split what each output lost.

    An output is dead that moves less than ``alive`` of what it should. ``on_frame`` is
    called with the index of every frame.

    Raises:
        EvaluationError: an output has another shape in the graph than in the engine or
            the source, or one of the engine is not finite.
    """
    names = run.names
    movements = {name: OutputTally(name) for name in names}
    compiled, whole = ({name: Tally(name) for name in names} for _ in range(2))
    known = [] if source is None else [name for name in names if name in source.outputs]
    quantized = {name: Tally(name) for name in known}
    floats = iter(()) if source is None else run.run_graph(source, known)
    # Float source, graph and engine, frame by frame
    for index, (_, truth) in enumerate(run.run_graph(run.session, names)):
        on_frame(index)
        run.check(index, truth)
        dumped, (_, exact) = run.dump[index], next(floats, (None, {}))
        for name in names:
            right = exact.get(name, truth[name])
            if name in quantized:
                quantized[name].add(right, truth[name], index)
            compiled[name].add(truth[name], dumped[name], index)
            whole[name].add(right, dumped[name], index)
            movements[name].add(right, dumped[name])
    losses = list[OutputLoss]()
    for name in names:
        moved = movements[name].result(alive)
        dead = str(moved) if moved.is_dead else ""
        own = quantized[name].sqnr_db if name in quantized else None
        parts = own, compiled[name].sqnr_db, whole[name].sqnr_db
        losses.append(OutputLoss(name, *parts, moved.moves, dead))
    return tuple(losses)


# SQNR of two float32 values that differ by rounding alone: two runtimes are 3e-5 to
# 6e-5 apart on UniAD-tiny (models/README.md)
ROUNDING_DB = 80.0
_QUANTIZERS = ("QuantizeLinear", "DynamicQuantizeLinear")


@dataclasses.dataclass(frozen=True)
class BorderValue:
    """A tensor that a module hands on: the node that makes it, and its SQNR."""

    module: str
    value: str
    node: str
    sqnr_db: float

    def __str__(self) -> str:
        module = f"module {self.module}, " if self.module else ""
        return f"{module}{self.value} of {self.node} is at {self.sqnr_db:.1f} dB"


@dataclasses.dataclass(frozen=True)
class FirstDifference:
    """Where a graph begins to differ from its source.

    Attributes:
        values: what was compared, in the order in which it is computed.
        floor_db: the SQNR below which a value counts as another.
        unknown: how many borders of either graph have no namesake in the other.
        outputs_differ: whether an output is below the floor.
    """

    values: tuple[BorderValue, ...]
    floor_db: float
    unknown: int
    outputs_differ: bool

    @property
    def first(self) -> BorderValue | None:
        """The first value below the floor, of a graph whose outputs differ."""
        below = (value for value in self.values if value.sqnr_db < self.floor_db)
        return next(below, None) if self.outputs_differ else None


def find_first_difference(
    source: ir.Model,
    candidate: ir.Model,
    frames: Sequence[Frame],
    provider: Provider = CPU,
) -> FirstDifference:
    """Find the first module of a graph that gives something else than its source does.

    The last of the frames is compared; the state of both graphs is what the source gave
    on those before. The floor is :data:`ROUNDING_DB`, or
    :data:`me2e_compress.fidelity.SQNR_FLOOR_DB` where a graph holds int8 or
    mostly narrow floats.

    Raises:
        EvaluationError: there is no frame, or the graphs share no value.
        FramesError: a frame does not fit one of the graphs.
        GraphError: onnxruntime cannot run one.
    """
    if not frames:
        raise EvaluationError("no frames to compare on")
    borders = dict.fromkeys([*_border_values(candidate), *_border_values(source)])
    known = _values_by_name(source).keys() & _values_by_name(candidate).keys()
    shared = [name for name in borders if name in known]
    if not shared:
        raise EvaluationError("the graphs share no value at the border of a module")
    # The inputs of the last frame, with the source's state
    session = Session(source, optimize=False, release=True, provider=provider)
    *before, last = frames if session.recurrent else frames[-1:]
    state = session.first_state(frames[0].arrays)
    for _, _, after in feed_forward(session, before, (), state):
        state = detached(after)
    state = session.first_state(last.arrays) if last.starts_scene else state
    feeds = {**last.arrays, **state}
    expected = _compute(source, shared, feeds, provider)
    values = _compute(candidate, shared, feeds, provider)
    # A few casts to float16 in a float32 graph are what is looked for; not so where a
    # graph holds int8, or narrow floats more than others.
    floor_db = ROUNDING_DB
    for model in (source, candidate):
        nodes = list(nodes_of(model))
        kinds = Counter(value.dtype for node in nodes for value in node.outputs)
        narrow = kinds[ir.DataType.FLOAT16] + kinds[ir.DataType.BFLOAT16]
        int8 = any(node.op_type in _QUANTIZERS for node in nodes)
        if int8 or narrow > kinds[ir.DataType.FLOAT]:
            floor_db = SQNR_FLOOR_DB
    unknown = len(borders) - len(shared)
    return _compare_values(candidate, expected, values, floor_db, unknown)


def first_difference_of_engine(
    model: ir.Model, run: EngineRun, provider: Provider = CPU
) -> FirstDifference:
    """Find where the tensors that an engine dumped begin to differ from its graph's.

    Every dumped tensor of the first frame is compared, inner ones too, with the floor
    :data:`me2e_compress.fidelity.SQNR_FLOOR_DB`.
    """
    feeds, _ = next(run.run_graph(run.session, run.names))
    known, dumped = _values_by_name(model), run.dump[0]
    names = [name for name in dumped if name in known]
    expected = _compute(model, names, feeds, provider)
    return _compare_values(model, expected, dumped, SQNR_FLOOR_DB, unknown=0)


def _compare_values(
    model: ir.Model,
    expected: Mapping[str, Array],
    values: Mapping[str, Array],
    floor_db: float,
    unknown: int,
) -> FirstDifference:
    """Compare arrays by name, in a graph's order; another shape is at -infinity dB."""

    def sqnr(name: str) -> float:
        if expected[name].shape != values[name].shape:
            return -np.inf
        tally = Tally(name)
        tally.add(expected[name], values[name], 0)
        return tally.sqnr_db

    compared = list[BorderValue]()
    for name, node in _values_by_name(model).items():
        if name in expected:
            called = f"{node.name or 'a node'} ({node.op_type})"
            compared.append(BorderValue(module_of(node), name, called, sqnr(name)))
    outputs = {value.name for value in model.graph.outputs}
    differ = any(v.sqnr_db < floor_db for v in compared if v.value in outputs)
    return FirstDifference(tuple(compared), floor_db, unknown, differ)


def _border_values(model: ir.Model) -> Iterator[str]:
    """Yield outputs, and what depends on inputs and is read by another module."""
    constant = constant_values(model)
    readers: dict[ir.Value, set[str]] = {}
    for node in model.graph:
        for value in reads_of(node):
            readers.setdefault(value, set()).add(module_of(node))
    for node in model.graph:
        for value in node.outputs:
            others = readers.get(value, set()) - {module_of(node)}
            leaves_module = others or value.is_graph_output()
            if value.name and value not in constant and leaves_module:
                yield value.name


def _values_by_name(model: ir.Model) -> dict[str, ir.Node]:
    """Map every named value to its node, in order."""
    pairs = ((value.name, node) for node in model.graph for value in node.outputs)
    return {name: node for name, node in pairs if name}


def _compute(
    model: ir.Model,
    names: Iterable[str],
    feeds: Mapping[str, Array],
    provider: Provider,
) -> dict[str, Array]:
    """Run a graph without optimization, and return values anywhere in it."""
    probed, wanted = model.clone(), list(names)
    graph.infer_shapes(probed)
    values = {value.name: value for node in probed.graph for value in node.outputs}
    missing = [values[name] for name in wanted if not values[name].is_graph_output()]
    probed.graph.outputs.extend(missing)
    session = Session(probed, optimize=False, release=True, provider=provider)
    return detached(session.run(feeds, wanted))
