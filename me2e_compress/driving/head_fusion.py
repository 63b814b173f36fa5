"""TCP's fusion of its trajectory head and its control head."""

from collections import deque
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from me2e_compress.driving.contract import PedalsAndWheel, Trajectory
from me2e_compress.driving.waypoint_pid import PidOptions, Place, WaypointPid

BRAKES = 0.5
"""More brake than this releases the throttle, in both agents."""

SLOW_MPS = 1.5
SLOW_IN_TURN_MPS, TURN_STEER = 1.0, 0.07
CREEPING, STARTING = 0.05, 0.5
"""Most throttle of Bench2DriveZoo's agent above that speed, and below it."""


class FusionOptions(BaseModel):
    """How the two heads are fused.

    ``tcp`` (OpenDriveLab/TCP, tcp_agent.py): one head leads, and the other has a share.
    The control head leads while the ego turns, else the trajectory head; the ego turns
    if more than ``turning_more_than`` of the latest steers exceed ``turning_steer``.
    ``bench2drive`` (Bench2DriveZoo, branch tcp/admlp, ``merge_ctrl_traj``): the mean of
    both, except that any braking becomes full braking, and above walking pace the
    throttle is close to none.

    Attributes:
        rule: ``tcp`` or ``bench2drive``.
        share: Weight of the head that does not lead.
        turning_steer: Steers above this count as turning.
        turning_more_than: The ego turns if more steers than this count.
        turning_window: How many of the latest steers are looked at.
        max_throttle: Upper limit.
        pid: Controller that follows the trajectory.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rule: Literal["tcp", "bench2drive"] = "tcp"
    share: float = Field(default=0.3, ge=0.0, le=1.0)
    turning_steer: float = Field(default=0.1, ge=0.0, le=1.0)
    turning_more_than: int = Field(default=10, ge=0)
    turning_window: int = Field(default=20, ge=1, le=4000)
    max_throttle: float = Field(default=0.75, ge=0.0, le=1.0)
    pid: PidOptions = PidOptions()


class HeadFusion:
    """Fuses one decision after the other; it remembers steers and errors."""

    def __init__(self, options: FusionOptions) -> None:
        self.options = options
        self.reset()

    def reset(self) -> None:
        """Begin a route."""
        self._pid = WaypointPid(self.options.pid)
        self._steers = deque[float]([], self.options.turning_window)

    @property
    def turning(self) -> bool:
        """Whether the control head leads."""
        large = sum(steer > self.options.turning_steer for steer in self._steers)
        return large > self.options.turning_more_than

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
        if self.options.rule == "bench2drive":
            return self._mean(followed, control, speed_mps)
        # TCP: the control head leads while the ego turns
        lead, other = (control, followed) if self.turning else (followed, control)
        fused = self._weighted(lead, other, self.options.share)
        self._steers.append(abs(fused.steer))
        return fused if fused.brake <= BRAKES else fused._replace(throttle=0.0)

    def _mean(
        self, followed: PedalsAndWheel, control: PedalsAndWheel, speed_mps: float
    ) -> PedalsAndWheel:
        both = self._weighted(followed, control, 0.5)
        if max(followed.brake, control.brake) > 0.0:
            return PedalsAndWheel(0.0, both.steer, 1.0)
        turns = abs(both.steer) > TURN_STEER
        slow = speed_mps <= (SLOW_IN_TURN_MPS if turns else SLOW_MPS)
        throttle = min(both.throttle, STARTING if slow else CREEPING)
        return PedalsAndWheel(throttle, both.steer, 0.0)

    def _weighted(
        self, lead: PedalsAndWheel, other: PedalsAndWheel, share: float
    ) -> PedalsAndWheel:
        pairs = zip(lead, other, strict=True)
        throttle, steer, brake = ((1 - share) * one + share * two for one, two in pairs)
        return PedalsAndWheel(min(throttle, self.options.max_throttle), steer, brake)
