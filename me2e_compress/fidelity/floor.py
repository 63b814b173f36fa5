"""The floor of fidelity, and what falls below it."""

import dataclasses

from me2e_compress.fidelity import SQNR_FLOOR_DB
from me2e_compress.fidelity.compare import Fidelity, SetFidelity

# Metres by which a car 1.9 m wide may leave the middle of a lane of 3.5 m and still
# keep 0.3 m to its lines
PLAN_FLOOR_M = 0.5
# What the excess is cut at: an output that should be zero has no finite one
LARGEST_EXCESS = 1e6


@dataclasses.dataclass(frozen=True)
class Shortfall:
    """One figure below the floor.

    Attributes:
        value: in dB; of the plan the mean displacement in metres.
        excess: noise amplitude over the largest allowed, above 1.
        part: its channels, as ``[:, 4:84]``, or its frames; empty if it is of all.
    """

    output: str
    value: float
    unit: str
    excess: float
    part: str = ""

    def __str__(self) -> str:
        return f"{self.output}{self.part} {format_figure(self.value, self.unit)}"


@dataclasses.dataclass(frozen=True)
class Floor:
    """How true a model must stay.

    Attributes:
        sqnr_db: least SQNR of outputs, over all frames and in the noisiest, dB; not of
            discrete ones, of the plan only where its displacement was not measured.
        plan_m: most mean displacement of the waypoints, metres.
    """

    sqnr_db: float = SQNR_FLOOR_DB
    plan_m: float = PLAN_FLOOR_M

    def shortfalls(
        self, fidelity: Fidelity, agents: SetFidelity | None = None
    ) -> tuple[Shortfall, ...]:
        """List the outputs that fail, the worst first; discrete ones never do.

        The plan is judged by its mean displacement, sets by the SQNR of their matched
        ``agents``, others overall, in their small channels or their noisiest frame.
        """
        below = list[Shortfall]()
        matched = {} if agents is None else agents.sqnr_db
        for output in fidelity.outputs:
            # The noise over what is allowed: above 1 is too much
            part = ""
            if fidelity.plan is not None and output.name == fidelity.plan_output:
                value, unit = fidelity.plan.mean_m, "m"
                excess = value / self.plan_m
            else:
                value, unit = matched.get(output.name, output.sqnr_db), "dB"
                if output.name in matched:
                    part = " of matched agents"
                elif output.small_db is not None and output.small_db < value:
                    value, part = output.small_db, output.small
                elif output.least_db < self.sqnr_db <= value:
                    value, part = output.least_db, " in its noisiest frame"
                # 10^(dB / 20): the ratio of amplitudes
                excess = min(float(10 ** ((self.sqnr_db - value) / 20)), LARGEST_EXCESS)
            if excess > 1 and not output.discrete:
                below.append(Shortfall(output.name, value, unit, excess, part))
        return tuple(sorted(below, key=lambda shortfall: -shortfall.excess))

    def __str__(self) -> str:
        return f"{self.sqnr_db:g} dB, {self.plan_m:g} m of plan"


def format_figure(value: float, unit: str) -> str:
    """Format a figure with its unit: dB to a tenth, metres to the centimetre."""
    return f"{value:z.1f} dB" if unit == "dB" else f"{value:.2f} {unit}"
