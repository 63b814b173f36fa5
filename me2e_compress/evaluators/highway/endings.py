"""Rules that end a route: the CARLA leaderboard's, as Bench2Drive sets them."""

from dataclasses import dataclass, field

from me2e_compress.metrics.episode import Ending
from me2e_compress.simulator.world import EndReason, World

BLOCKED_MPS = 0.1
BLOCKED_US = 60_000_000
TIMEOUT_US = 200_000_000
"""4000 ticks of 50 ms; the leaderboard's own limits are longer."""
DEVIATION_M = 30.0
ASTRAY_M = 15.0
ASTRAY_SHARE = 0.3


@dataclass
class EndingRules:
    """Decides when one route is over; constants of Bench2Drive's atomic_criteria.py.

    * the goal is reached, or the ego collides: the world itself ends there. CARLA
      drives on after a collision, so its driving scores multiply more penalties;
    * deviation: 30 m from the route, or more than 30 % of its length driven at least 15
      m away from it;
    * blocked: at most 0.1 m/s for 60 s;
    * timed out: 200 s.
    """

    _stopped_at_us: int | None = field(default=None, init=False)
    _astray_m: float = field(default=0.0, init=False)
    _last_us: int = field(default=0, init=False)

    def ending(self, world: World, speed_mps: float) -> Ending | None:
        """Return why the route is over, or None; call it after every step."""
        if world.reason is not None:
            reached = world.reason is EndReason.GOAL
            return Ending.COMPLETED if reached else Ending.COLLISION
        if self._deviated(world, speed_mps):
            return Ending.DEVIATION
        if self._blocked(world, speed_mps):
            return Ending.BLOCKED
        return Ending.TIMEOUT if world.time_us >= TIMEOUT_US else None

    def _deviated(self, world: World, speed_mps: float) -> bool:
        away_m = abs(world.lateral_m)
        passed_s = (world.time_us - self._last_us) / 1e6
        self._last_us = world.time_us
        if away_m >= ASTRAY_M:
            self._astray_m += speed_mps * passed_s
        return (
            away_m >= DEVIATION_M or self._astray_m > ASTRAY_SHARE * world.path.goal_m
        )

    def _blocked(self, world: World, speed_mps: float) -> bool:
        if speed_mps > BLOCKED_MPS:
            self._stopped_at_us = None
            return False
        if self._stopped_at_us is None:
            self._stopped_at_us = world.time_us
        return world.time_us - self._stopped_at_us >= BLOCKED_US
