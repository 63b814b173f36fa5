"""What a policy is asked: one frame that is drawn."""

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.contract import Observation, Policy, Trajectory, check_answer
from me2e_compress.simulator.camera_rig import CameraRig

RIG = CameraRig(16, 24)


def observation(seed: int = 0, command: int = 2) -> Observation:
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (6, 16, 24, 3)).astype(np.uint8)
    can_bus = rng.normal(size=18).astype(np.float32)
    return Observation(0, images, RIG.lidar2img, can_bus, command, 3.0)


def planned(policy: Policy, seen: Observation) -> npt.NDArray[np.floating]:
    """Ask a policy that answers waypoints."""
    result = check_answer(policy.plan(seen))
    assert isinstance(result, Trajectory)
    return result.points
