"""The first module and node after which a graph differs from its source.

Both graphs run once with a sketch of every value. A value that differs, computed of
values that do not, comes from a wrong place; but rounding that grew on the way looks
alike. So the nodes of every suspected place run once more, alone, on what the source
computed there: what they still get wrong is their own.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Self

import onnx_ir as ir

from me2e_compress.errors import EvaluationError
from me2e_compress.fidelity.correspondence import Held, hold
from me2e_compress.fidelity.floor import SQNR_FLOOR_DB
from me2e_compress.fidelity.places import Place, Region, Regions, merged
from me2e_compress.fidelity.run_alone import Arrays, Truth, own_gaps
from me2e_compress.fidelity.sketches import decibels
from me2e_compress.fidelity.values import Fed, Values
from me2e_compress.graph.nodes import nodes_of
from me2e_compress.graph.provenance import module_of
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.providers import CPU, Provider

ROUNDING_DB = 100.0
"""Above this SQNR two float32 values are equal but for rounding: 1e-5 of the amplitude.
Of VAD-tiny's values after the exact passes those below it are right when computed of
equal inputs, or reach no output (``benchmarks/bench_locate.py``)."""

AT_ONCE, MOST = 4, 32
"""Places that run alone in one round, whose values fit in memory together; and in all.
"""

NARROW = (ir.DataType.FLOAT16, ir.DataType.BFLOAT16)


@dataclasses.dataclass(frozen=True)
class ModuleLoss:
    """What a module was given and what it gave: the lowest SQNR, dB, of those values.

    None where nothing was compared.
    """

    module: str
    compared: int
    before_db: float | None
    after_db: float | None


@dataclasses.dataclass(frozen=True)
class FirstDifference:
    """Where a graph begins to differ from its source.

    Attributes:
        places: the wrong ones, in the order in which they are computed.
        modules: what every module was given and gave, in that order too.
        floor_db: the SQNR below which a value counts as another.
        lossy: a graph holds int8 or mostly narrow floats: a place need not be
            wrong by itself, the loss adds up.
        compared: how many values were held against another.
        different: how many of them are below the floor.
        unknown: how many have no counterpart in the source.
        outputs_differ: whether an output is below the floor.
        inherited: suspected places that, run alone on the source's values, were right.
        frames: how many were run.
    """

    places: tuple[Place, ...]
    modules: tuple[ModuleLoss, ...]
    floor_db: float
    lossy: bool
    compared: int
    different: int
    unknown: int
    outputs_differ: bool
    inherited: int
    frames: int

    @property
    def first(self) -> Place | None:
        """The first place whose error reaches an output; None where none does."""
        return next((each for each in self.places if each.reaches), None)


@dataclasses.dataclass(frozen=True, eq=False)
class Source:
    """A graph that was run with its sketches, to hold many others against.

    Each is run over the same frames, its nodes as they stand.
    """

    values: Values
    frames: tuple[Frame, ...]
    fed: Fed
    provider: Provider = CPU

    @classmethod
    def of(
        cls, model: ir.Model, frames: Iterable[Frame], provider: Provider = CPU
    ) -> Self:
        """Run a graph over frames.

        Raises:
            EvaluationError: there is no frame.
            FramesError: a frame does not fit.
            GraphError: onnxruntime cannot run the graph.
        """
        shown = tuple(frames)
        if not shown:
            raise EvaluationError("no frames to compare on")
        values = Values(model, shown)
        values.measure_shapes(shown, provider, values.unshaped())
        return cls(values, shown, values.run(shown, provider), provider)

    def first_difference(
        self, candidate: ir.Model, floor_db: float | None = None
    ) -> FirstDifference:
        """Find where another graph begins to differ; it gets this one's state.

        ``floor_db`` None is :data:`ROUNDING_DB`, or
        :data:`me2e_compress.fidelity.floor.SQNR_FLOOR_DB` where a graph holds int8 or
        mostly narrow floats.

        Raises:
            EvaluationError: the graphs share no value.
            FramesError: the other graph takes other inputs.
            GraphError: onnxruntime cannot run it.
        """
        a, b = self.values, Values(candidate, self.frames)
        b.take_shapes(a)
        b.run(self.frames, self.provider, self.fed)
        lossy = _is_lossy(a.model) or _is_lossy(b.model)
        floor = floor_db or (SQNR_FLOOR_DB if lossy else ROUNDING_DB)
        held = hold(a, b, _amplitude(floor))
        if not held:
            raise EvaluationError("the graphs share no value, by name or by content")
        truth = Truth(a.model, self.fed, self.provider)
        found = found_in(
            b.model, held, truth.arrays, self.fed, floor, lossy, self.provider
        )
        return dataclasses.replace(found, unknown=len(b.by_name) - len(held))


def found_in(
    model: ir.Model,
    held: Mapping[ir.Value, Held],
    arrays: Arrays,
    fed: Fed,
    floor: float,
    lossy: bool,
    provider: Provider,
) -> FirstDifference:
    """Suspect, try alone, and tell."""
    tolerance = _amplitude(floor)
    regions = Regions(model, held, tolerance)
    wrong, tried = list[tuple[Region, float | None]](), 0
    for tier in regions.suspects()[: 1 if lossy else 3]:
        for start in range(0, min(len(tier), MOST - tried), AT_ONCE):
            batch = tier[start : start + AT_ONCE]
            own = own_gaps(model, batch, held, arrays, fed, provider)
            tried += len(batch)
            wrong += [
                (region, each)
                for region, each in zip(batch, own, strict=True)
                if lossy or each is None or each > tolerance
            ]
        if wrong:
            break
    return FirstDifference(
        merged(regions, wrong),
        _losses(regions),
        floor,
        lossy,
        len(held),
        sum(each.gap > tolerance for each in held.values()),
        0,
        any(regions.differs(value) for value in regions.outputs),
        tried - len(wrong),
        len(fed),
    )


def _losses(regions: Regions) -> tuple[ModuleLoss, ...]:
    """Sum up what every module was given and gave."""
    held = regions.held
    given, gave = dict[str, list[float]](), dict[str, list[float]]()
    counts = dict[str, int]()
    for node in regions.nodes:
        module = module_of(node)
        counts.setdefault(module, 0)
        for value in node.outputs:
            if value not in held:
                continue
            counts[module] += 1
            others = {module_of(each) for each in regions.readers.get(value, ())}
            if value.is_graph_output() or others - {module}:
                gave.setdefault(module, []).append(held[value].gap)
            for other in sorted(others - {module}):
                given.setdefault(other, []).append(held[value].gap)
    return tuple(
        ModuleLoss(
            module, count, _decibels(given.get(module)), _decibels(gave.get(module))
        )
        for module, count in counts.items()
        if count
    )


def _decibels(gaps: Sequence[float] | None) -> float | None:
    return decibels(max(gaps)) if gaps else None


def _amplitude(sqnr_db: float) -> float:
    return float(10 ** (-sqnr_db / 20))


def _is_lossy(model: ir.Model) -> bool:
    """Return whether a graph holds int8, or narrow floats more than others.

    A few casts to float16 in a float32 graph are what is looked for.
    """
    wide = narrow = 0
    for node in nodes_of(model):
        if node.op_type in ("QuantizeLinear", "DynamicQuantizeLinear"):
            return True
        for value in node.outputs:
            narrow += value.dtype in NARROW
            wide += value.dtype == ir.DataType.FLOAT
    return narrow > wide
