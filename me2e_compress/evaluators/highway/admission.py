"""The admission gate: a route must tell a driver from a sleepwalker.

A route is admitted if the privileged expert solves it and the blind driver, who keeps
one speed on the route's centre, commits an infraction on it at every one of
`blind.SPEEDS_MPS`. Running out of time, standing blocked or going astray is none.
"""

from dataclasses import dataclass

from me2e_compress.evaluators.highway.blind import SPEEDS_MPS, Blind
from me2e_compress.evaluators.highway.dry_run import DryRun, dry_run
from me2e_compress.evaluators.highway.expert import Expert
from me2e_compress.simulator.routes import Route


@dataclass(frozen=True, slots=True)
class Admission:
    """What the gate says of one route.

    Attributes:
        route: Which.
        expert: How the expert drove it; None if the blind driver had decided already.
        blind: How the blind driver drove it at each speed that was tried.
    """

    route: Route
    expert: DryRun | None
    blind: tuple[DryRun, ...]

    @property
    def refusal(self) -> str | None:
        """Why the route is not admitted, None if it is."""
        for speed, drive in zip(SPEEDS_MPS, self.blind, strict=False):
            if not drive.infractions:
                return f"the blind driver commits no infraction at {speed:g} m/s"
            if drive.actors_crashed:
                return f"two actors collide while the ego drives at {speed:g} m/s"
        if self.expert is None:
            return "the expert did not drive it"
        if self.expert.actors_crashed:
            return "two actors collide while the expert drives"
        if self.expert.infractions:
            return f"the expert commits: {', '.join(self.expert.infractions)}"
        if not self.expert.solved:
            why = self.expert.failure or self.expert.ending.value
            return f"the expert ends after {self.expert.seconds:g} s: {why}"
        if not self.expert.triggered:
            return "the scenario's event never happened"
        return None

    @property
    def admitted(self) -> bool:
        """Whether the route may be used."""
        return self.refusal is None


def examine(route: Route) -> Admission:
    """Put one route through the gate; the cheap blind drives come first."""
    drives = list[DryRun]()
    for speed in SPEEDS_MPS:
        drives.append(dry_run(route, Blind(speed)))
        if not drives[-1].infractions:
            return Admission(route, None, tuple(drives))
    return Admission(route, dry_run(route, Expert()), tuple(drives))
