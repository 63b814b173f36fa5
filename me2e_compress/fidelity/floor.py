"""The floor of fidelity: what falls below it, and which outputs it cannot judge."""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Self

import numpy as np
import onnx_ir as ir

from me2e_compress.fidelity import SQNR_FLOOR_DB
from me2e_compress.fidelity.compare import Fidelity, Reference
from me2e_compress.graph.nodes import (
    FLOATS,
    makers_of,
    nodes_in,
    nodes_inside,
    reads_of,
)
from me2e_compress.runtime.frames import Frame, Frames
from me2e_compress.runtime.session import Session

PLAN_FLOOR_M = 0.5
"""A car 1.9 m wide in the middle of a lane of 3.5 m still keeps 0.3 m to its lines."""

MOST_EXCESS = 1e6
"""Excess of an output that should be zero and is not."""

STEPS = 127
"""Int8's grid has so many steps on either side of zero."""


@dataclasses.dataclass(frozen=True)
class Shortfall:
    """One figure below the floor.

    Attributes:
        value: in dB; of the plan the mean displacement in metres.
        excess: noise amplitude over the largest allowed, above 1.
        part: its channels, as ``[:, 4:84]``; empty if it is of all.
    """

    output: str
    value: float
    unit: str
    excess: float
    part: str = ""

    def __str__(self) -> str:
        return f"{self.output}{self.part} {shown(self.value, self.unit)}"


@dataclasses.dataclass(frozen=True)
class Floor:
    """How true a model must stay.

    Attributes:
        sqnr_db: least SQNR of outputs, dB; not of discrete ones, of the plan
            only where its displacement was not measured.
        plan_m: most mean displacement of the waypoints, metres.
    """

    sqnr_db: float = SQNR_FLOOR_DB
    plan_m: float = PLAN_FLOOR_M

    def shortfalls(
        self, found: Fidelity, unsteady: Collection[str] = ()
    ) -> tuple[Shortfall, ...]:
        """List what is below the floor, the worst first, without unsteady outputs."""
        below = []
        for each in found.outputs:
            # The noise over what is allowed: above 1 is too much.
            part = ""
            if found.plan is not None and each.name == found.plan_output:
                value, unit = found.plan.mean_m, "m"
                excess = value / self.plan_m
            else:
                value, unit = each.sqnr_db, "dB"
                if each.small_db is not None and each.small_db < value:
                    value, part = each.small_db, each.small
                excess = min(float(10 ** ((self.sqnr_db - value) / 20)), MOST_EXCESS)
            if excess > 1 and not each.discrete and each.name not in unsteady:
                below.append(Shortfall(each.name, value, unit, excess, part))
        return tuple(sorted(below, key=lambda each: -each.excess))

    def __str__(self) -> str:
        return f"{self.sqnr_db:g} dB, {self.plan_m:g} m of plan"


def shown(value: float, unit: str) -> str:
    """Format a figure with its unit: dB to a tenth, metres to the centimetre."""
    return f"{value:z.1f} dB" if unit == "dB" else f"{value:.2f} {unit}"


@dataclasses.dataclass(frozen=True)
class Rounding:
    """What rounding one input to int8 does to the graph that nothing was done to.

    An output that this puts below the floor is *unsteady* if something on the way from
    the input chooses: it picks between candidates that are nearly equal, and its SQNR
    counts the picks and says little of the graph. Where nothing chooses, int8 is simply
    too coarse for it.

    Attributes:
        input: the largest float input, usually the images; states excepted.
        values: SQNR of the outputs that fall below the floor, dB; metres of a plan.
        choices: the node that chooses, by unsteady output.
    """

    input: str
    values: Mapping[str, float]
    choices: Mapping[str, str]

    @classmethod
    def of(
        cls,
        session: Session,
        frames: Frames,
        model: ir.Model,
        floor: Floor,
        outputs: Collection[str],
    ) -> Self:
        """Run a graph, which is `model`, on frames with and without the input rounded.

        Of the `outputs` alone it says anything.
        """
        first = next(iter(frames))
        sizes = {
            name: values.size
            for name, values in first.arrays.items()
            if values.dtype.kind == "f" and name not in session.recurrent
        }
        name = max(sizes, key=lambda each: sizes[each], default="")
        if not name:
            return cls("", {}, {})
        # Frames of which that input is rounded to int8's grid, one in memory at a time.
        rounded = Reference.of(session, frames).compare(
            session, (_rounded(frame, name) for frame in frames)
        )
        below = floor.shortfalls(rounded)
        low = {each.output: each.value for each in below if each.output in outputs}
        choices = {each: choice_between(model, name, each) for each in low}
        return cls(name, low, {k: v for k, v in choices.items() if v})


CHOICES = frozenset(
    {
        *("ArgMax", "ArgMin", "Ceil", "Equal", "Floor", "Greater", "GreaterOrEqual"),
        *("Hardmax", "Less", "LessOrEqual", "NonMaxSuppression", "NonZero", "Round"),
        *("Sign", "TopK", "Unique"),
    }
)
"""Operators whose result jumps; a Cast of floats to integers does, too."""


def choice_between(model: ir.Model, source: str, output: str) -> str:
    """Name the last node between an input and an output that chooses; empty if none."""

    def chooses(node: ir.Node) -> bool:
        if node.op_type == "Cast":
            kinds = [v.dtype for v in (*node.inputs, *node.outputs) if v is not None]
            return kinds[0] in FLOATS and kinds[-1] not in FLOATS
        nearest = node.attributes.get_string("mode", "") == "nearest"
        return node.op_type in CHOICES or (node.op_type == "GridSample" and nearest)

    reached = {value for value in model.graph.inputs if value.name == source}
    behind = makers_of(v for v in model.graph.outputs if v.name == output)
    choice = ""
    for node in model.graph:
        if node not in behind or reached.isdisjoint(reads_of(node)):
            continue
        reached.update(node.outputs)
        function = model.functions.get(node.op_identifier())
        inner = nodes_inside(node) if function is None else nodes_in(function)
        if any(map(chooses, (node, *inner))):
            choice = f"{node.name} ({node.op_type})"
    return choice


def _rounded(frame: Frame, name: str) -> Frame:
    given = frame.arrays[name]
    values = np.asarray(given, np.float64)
    step = float(np.abs(values).max(initial=0.0)) / STEPS or 1.0
    grid = (np.rint(values / step) * step).astype(given.dtype)
    return dataclasses.replace(frame, arrays={**frame.arrays, name: grid})
