"""Estimate what int8 of every node costs every output, by first-order propagation.

The gradient g of an output, weighted by random signs, meets the local error e of each
int8 node: E (g e)^2 = |J e|^2 is the power of the noise that e makes at the output. One
backward pass so tells of all nodes what would take an inference for each. Choices (a
TopK, comparisons, integers) count as fixed.

One draw of signs says little of g e, in which what the channels of e do adds up or
cancels. If channels were independent, the sum of their squares would do: steady, but
wrong where an output is so small that chance decides. Both are mixed; see `PRIOR`.
"""

import dataclasses
import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import rewrite, static_shape
from me2e_compress.graph.nodes import FLOATS
from me2e_compress.quantization.plan import RESIDUAL, QuantPlan
from me2e_compress.runtime.frames import Array, Frame, Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay
from me2e_compress.sensitivity.error_sources import ErrorSources, Reading
from me2e_compress.sensitivity.gradients import Backward, Tape
from me2e_compress.sensitivity.gradients.tape import given
from me2e_compress.targets.base import Grids

MOST_HELD = 1_500_000_000
"""Bytes of a graph's own tensors that may be kept in memory for its gradients."""

PRIOR = 0.5
"""Draws that the squares of independent channels count as, per number of an output
beyond the first: of one number, a draw tells all.

On TCP, 36 nodes, a plan of 8 numbers and as many draws, rank correlation with measured
noise was 0.94 for 2 to 8 draws, 0.81 for the squares alone, 0.91 for the draws alone,
0.99 for the sums without chance (a pass for each number): 2026-11-24, before errors of
rounded weights cancelled, by a script that is not kept."""

NO_PATH = "no output depends on it but by choices or whole numbers"

_SIGNS, _NOISE, _SIGNAL = (
    f"me2e_sensitivity_{name}" for name in ("signs", "noise", "signal")
)


@dataclasses.dataclass(frozen=True, eq=False)
class NodeCost:
    """What int8 of one node costs, with the residual Add that follows it.

    Attributes:
        output: name of the node's first output, which is unique.
        noise: noise amplitude by output, relative to its signal; None if not estimated.
        reason: why it was not.
    """

    node: str
    output: str
    op: str
    module: str
    noise: Mapping[str, float] | None
    reason: str = ""


def estimate(
    model: ir.Model,
    plan: QuantPlan,
    grids: Grids,
    frames: Frames,
    *,
    outputs: Collection[str] | None = None,
    seed: int = 0,
    threads: int = 0,
    provider: Provider = CPU,
    most_held: int = MOST_HELD,
) -> tuple[NodeCost, ...]:
    """Estimate the cost of each int8 node of a plan for each output, in graph order.

    Each run over a frame tells of one output, they take turns; where there are more
    outputs, the frames are run again. Outputs of whole numbers or of open size are
    left out; ``outputs`` None asks for all others. Nodes whose gradients need more than
    ``most_held`` bytes of the graph's own tensors are not estimated.
    """
    written = _write(model, plan, grids, outputs, most_held)
    effects = _Effects.of(written)
    signal = np.zeros(len(written.seeds))
    if written.readings:
        session = Session(
            written.model, threads=threads, frugal=True, provider=provider
        )
        fed = written.fed(frames, np.random.default_rng(seed))
        for at, values in enumerate(replay(session, fed, [_NOISE, _SIGNAL])):
            turn = at % len(signal)
            effects.add(turn, values[_NOISE])
            signal[turn] += values[_SIGNAL][turn]
    return tuple(written.costs(plan, effects.power(), signal))


@dataclasses.dataclass(frozen=True)
class _Written:
    """A graph that gives effects of errors by reading, and signal power by output.

    ``seeds`` are the inputs for random signs, by output; ``readings`` are the parts of
    the vector of effects, ``missing`` the layers that lack one, with the reasons.
    """

    model: ir.Model
    seeds: Mapping[str, ir.Value]
    readings: Sequence[Reading]
    missing: Mapping[str, str]

    def fed(self, frames: Frames, random: np.random.Generator) -> Iterator[Frame]:
        """Yield frames with random signs for one output in turn, zeros for others."""
        rounds = -(-len(self.seeds) // len(frames))
        for at, frame in enumerate(itertools.chain(*[frames] * max(rounds, 1))):
            if at >= max(len(frames), len(self.seeds)):
                return
            arrays: dict[str, Array] = dict(frame.arrays)
            for turn, value in enumerate(self.seeds.values()):
                shape, kind = static_shape(value) or (), value.dtype
                signs = np.zeros(shape, None if kind is None else kind.numpy())
                if turn == at % len(self.seeds):
                    signs += random.integers(0, 2, shape) * 2 - 1
                arrays[str(value.name)] = signs
            yield dataclasses.replace(frame, arrays=arrays)

    def costs(
        self, plan: QuantPlan, power: Mapping[str, Array], signal: Array
    ) -> Iterator[NodeCost]:
        """Yield what was found of each int8 node; residual Adds follow another's."""
        for each in plan.placed:
            if each.rule == RESIDUAL:
                continue
            reason = self.missing.get(
                each.output, "" if each.output in power else NO_PATH
            )
            noise = None
            if not reason:
                noise = {
                    name: float(np.sqrt(power[each.output][turn] / signal[turn]))
                    for turn, name in enumerate(self.seeds)
                    if signal[turn] > 0
                }
            yield NodeCost(each.node, each.output, each.op, each.module, noise, reason)


class _Effects:
    """What errors do to outputs, by layer, summed over draws of signs."""

    def __init__(self, readings: Sequence[Reading], sizes: Sequence[int]) -> None:
        self._names = list(dict.fromkeys(each.layer for each in readings))
        places = {name: at for at, name in enumerate(self._names)}
        self._layers = np.array([places[each.layer] for each in readings])
        self._parts = np.array([(each.squares, each.sums) for each in readings])
        self._starts = np.cumsum([0, *(each.size for each in readings[:-1])])
        self._prior = PRIOR * (np.array(sizes, np.float64) - 1)
        self._draws = np.zeros(len(sizes))
        self._totals = np.zeros((2, len(self._names), len(sizes)))

    @classmethod
    def of(cls, written: _Written) -> "_Effects":
        shapes = [static_shape(value) or () for value in written.seeds.values()]
        return cls(written.readings, [math.prod(each) for each in shapes])

    def add(self, turn: int, noise: Array) -> None:
        """Add a draw for one output: squares and sums of every reading."""
        self._draws[turn] += 1
        found = noise.astype(np.float64)
        for at, values in enumerate((found**2, found)):
            parts = np.add.reduceat(values, self._starts) * self._parts[:, at]
            whole = np.bincount(self._layers, parts)
            self._totals[at, :, turn] += whole**2 if at else whole

    def power(self) -> dict[str, Array]:
        """Return the power of each layer's noise at every output, summed over draws."""
        weight = self._prior / np.maximum(self._prior + self._draws, 1)
        squares, squared = self._totals
        power = weight * squares + (1 - weight) * squared
        return dict(zip(self._names, power, strict=True))


def _write(
    model: ir.Model,
    plan: QuantPlan,
    grids: Grids,
    outputs: Collection[str] | None,
    most_held: int,
) -> _Written:
    # every reading of an activation becomes a value of its own, fused nodes bodies
    sources = ErrorSources.of(model, plan, grids)
    main = sources.model.graph
    reached = sources.reached()
    ports = [
        value
        for value in main.outputs
        if value in reached and value.dtype in FLOATS
        and static_shape(value) is not None
        and (outputs is None or value.name in outputs)
    ]  # fmt: skip
    nodes, tape = list(main), Tape(sources.model)
    signal = [tape.op("ReduceSumSquare", [each], {"keepdims": 0}) for each in ports]
    # the backward pass; where a gradient is complete it meets the error
    back, seeds = Backward(tape, reached, most_held), dict[str, ir.Value]()
    for value in ports:
        signs = ir.Value(
            name=f"{_SIGNS}_{value.name}", shape=value.shape, type=value.type
        )
        main.inputs.append(signs)
        seeds[str(value.name)] = signs
        back.seed(value, signs)
    readings = list[Reading]()
    for node in reversed(nodes):
        found = back.found.get(node.outputs[0])
        to_input = None
        if found is None or (rounded := sources.rounded(node)) is None:
            back.pass_through(node)
        else:
            exact = node.inputs[1]
            node.replace_input_with(1, tape.constant(rounded))
            back.pass_through(node)
            node.replace_input_with(1, exact)
            to_input = back.found.get(given(node.inputs[0]))
        if found is not None and sources.layer_of(node):
            readings += sources.readings(tape, node, found, to_input)
    # one vector of each kind
    effects = [each.vector for each in readings]
    powers = [tape.shaped(each, [-1]) for each in signal]
    for name, values in ((_NOISE, effects), (_SIGNAL, powers)):
        if values:
            joined = tape.op("Concat", values, {"axis": 0})
            joined.name, joined.type = name, ir.TensorType(ir.DataType.FLOAT)
            main.outputs.append(joined)
    rewrite.remove_dead(main)
    return _Written(sources.model, seeds, readings, sources.behind(back.missing))
