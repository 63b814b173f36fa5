"""The floor of fidelity: what falls below it, and which outputs it cannot judge."""

import dataclasses
import math
from collections.abc import Collection, Iterator

import numpy as np

from me2e_compress.fidelity.compare import Fidelity, Reference
from me2e_compress.runtime.frames import Frame, Frames

SQNR_FLOOR_DB = 20.0
"""Noise of a tenth of the signal's amplitude."""

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
    """

    output: str
    value: float
    unit: str
    excess: float

    def __str__(self) -> str:
        return f"{self.output} {shown(self.value, self.unit)}"


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

    def excess(self, found: Fidelity, output: str) -> float:
        """Return an output's noise over what is allowed: above 1 is too much.

        An output that was not compared has no noise.
        """
        if found.plan is not None and output == found.plan_output:
            return found.plan.mean_m / self.plan_m
        names = {each.name: each.sqnr_db for each in found.outputs}
        sqnr = names.get(output, math.inf)
        return float(min(10 ** ((self.sqnr_db - sqnr) / 20), MOST_EXCESS))

    def shortfalls(
        self, found: Fidelity, unsteady: Collection[str] = ()
    ) -> tuple[Shortfall, ...]:
        """List what is below the floor, the worst first, without unsteady outputs."""
        below = []
        for each in found.outputs:
            excess = self.excess(found, each.name)
            if excess <= 1 or each.discrete or each.name in unsteady:
                continue
            value, unit = each.sqnr_db, "dB"
            if found.plan is not None and each.name == found.plan_output:
                value, unit = found.plan.mean_m, "m"
            below.append(Shortfall(each.name, value, unit, excess))
        return tuple(sorted(below, key=lambda each: -each.excess))

    def __str__(self) -> str:
        return f"{self.sqnr_db:g} dB, {self.plan_m:g} m of plan"


def shown(value: float, unit: str) -> str:
    """Format a figure with its unit: dB to a tenth, metres to the centimetre."""
    return f"{value:z.1f} dB" if unit == "dB" else f"{value:.2f} {unit}"


def unsteady_outputs(reference: Reference, floor: Floor) -> dict[str, float]:
    """Find the outputs that fall below the floor although nothing was compressed.

    The model runs on its frames again, their largest float input (usually the images)
    rounded to int8, which is a smaller change than int8 anywhere in the graph. An
    output that this puts below the floor chooses between candidates that are nearly
    equal; its SQNR counts the choices and says little of the graph. Returns the SQNR by
    output, dB; for the plan the displacement, metres.
    """
    session = reference.session
    rounded = reference.compare(
        session, _Rounded(reference.frames, tuple(session.recurrent))
    )
    return {each.output: each.value for each in floor.shortfalls(rounded)}


@dataclasses.dataclass(frozen=True)
class _Rounded:
    """Frames whose largest float input, states excepted, is rounded to int8's grid."""

    frames: Frames
    states: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return map(self._round, self.frames)

    def _round(self, frame: Frame) -> Frame:
        sizes = {
            name: values.size
            for name, values in frame.arrays.items()
            if values.dtype.kind == "f" and name not in self.states
        }
        if not sizes:
            return frame
        return _rounded(frame, max(sizes, key=lambda name: sizes[name]))


def _rounded(frame: Frame, name: str) -> Frame:
    values = np.asarray(frame.arrays[name], np.float64)
    step = float(np.abs(values).max(initial=0.0)) / STEPS or 1.0
    grid = (np.rint(values / step) * step).astype(frame.arrays[name].dtype)
    return dataclasses.replace(frame, arrays={**frame.arrays, name: grid})
