"""How TCP's agents fuse the trajectory head and the control head."""

from collections import deque
from typing import Literal

from me2e_compress.driving.contract import PedalsAndWheel
from me2e_compress.runtime.plan_adapter import Trajectory
from models.tcp.waypoint_pid import PidOptions, Place, WaypointPid

Rule = Literal["tcp", "bench2drive"]

SHARE = 0.3
"""Weight of the head that does not lead."""
TURNING_STEER, TURNING_MORE_THAN, TURNING_WINDOW = 0.1, 10, 20
"""The ego turns if more of the latest steers than this exceed that steer."""
MAX_THROTTLE = 0.75
BRAKES = 0.5
"""More brake than this releases the throttle, in both agents."""

SLOW_MPS = 1.5
SLOW_IN_TURN_MPS, TURN_STEER = 1.0, 0.07
CREEPING, STARTING = 0.05, 0.5
"""Most throttle of Bench2DriveZoo's agent above that speed, and below it."""


class HeadFusion:
    """Fuses one decision after the other; it remembers steers and errors.

    Rule ``tcp`` (OpenDriveLab/TCP, tcp_agent.py): one head leads, and the other has a
    share. The control head leads while the ego turns, else the trajectory head.
    ``bench2drive`` (Bench2DriveZoo, branch tcp/admlp, ``merge_ctrl_traj``): the mean of
    both, except that any braking becomes full braking, and above walking pace the
    throttle is close to none.
    """

    def __init__(self, rule: Rule) -> None:
        self.rule = rule
        self.reset()

    def reset(self) -> None:
        """Begin a route."""
        self._pid = WaypointPid(PidOptions())
        self._steers = deque[float]([], TURNING_WINDOW)

    @property
    def turning(self) -> bool:
        """Whether the control head leads."""
        return sum(each > TURNING_STEER for each in self._steers) > TURNING_MORE_THAN

    def fuse(
        self,
        plan: Trajectory,
        control: PedalsAndWheel,
        speed_mps: float,
        node: Place,
    ) -> PedalsAndWheel:
        """Return the fused controls.

        ``node`` is the target point, metres to the right and forward.
        """
        followed = self._pid.control(plan, speed_mps, node)
        if self.rule == "bench2drive":
            return _mean(followed, control, speed_mps)
        # TCP: the control head leads while the ego turns
        lead, other = (control, followed) if self.turning else (followed, control)
        fused = _weighted(lead, other, SHARE)
        self._steers.append(abs(fused.steer))
        return fused if fused.brake <= BRAKES else fused._replace(throttle=0.0)


def _mean(
    followed: PedalsAndWheel, control: PedalsAndWheel, speed_mps: float
) -> PedalsAndWheel:
    both = _weighted(followed, control, 0.5)
    if max(followed.brake, control.brake) > 0.0:
        return PedalsAndWheel(0.0, both.steer, 1.0)
    turns = abs(both.steer) > TURN_STEER
    slow = speed_mps <= (SLOW_IN_TURN_MPS if turns else SLOW_MPS)
    throttle = min(both.throttle, STARTING if slow else CREEPING)
    return PedalsAndWheel(throttle, both.steer, 0.0)


def _weighted(
    lead: PedalsAndWheel, other: PedalsAndWheel, share: float
) -> PedalsAndWheel:
    pairs = zip(lead, other, strict=True)
    throttle, steer, brake = ((1 - share) * one + share * two for one, two in pairs)
    return PedalsAndWheel(min(throttle, MAX_THROTTLE), steer, brake)
