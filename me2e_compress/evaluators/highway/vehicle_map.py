"""Convert CARLA's throttle, brake and steer to the control of this ego.

Full pedals are the limits of the ego's engine and brakes, as in CARLA: throttle 4 m/s2,
brake 8 m/s2, both together their difference; with neither the ego keeps its speed (no
drag, no creeping).

A steer gives the circle that CARLA's car would drive, by the kinematic bicycle that
World on Rails (Chen, Koltun and Kraehenbuehl 2021) fitted to CARLA and TransFuser and
its successors use. A full steer is a circle of 3.7 m there; the wheels of this ego turn
to one of 7.7 m, so a steer beyond 0.47 changes nothing.
"""

import math

from me2e_compress.driving.contract import PedalsAndWheel
from me2e_compress.simulator.bicycle import steering_of
from me2e_compress.simulator.scene import Control
from me2e_compress.simulator.traffic.bodies import ACCELERATION_RANGE_MPS2

STEER_GAIN_RAD = 0.36848336
FRONT_AXLE_M, REAR_AXLE_M = -0.090769015, 1.4178275
"""World on Rails: wheel angle of a full steer, axles from the centre."""


def control_of(asked: PedalsAndWheel, length_m: float) -> Control:
    """Return acceleration and front wheel angle; steer to the right is positive."""
    braking, thrust = ACCELERATION_RANGE_MPS2
    curvature = curvature_by(-asked.steer)
    sine = min(max(curvature * length_m / 2, -1.0), 1.0)
    return Control(
        asked.throttle * thrust + asked.brake * braking, steering_of(math.asin(sine))
    )


def curvature_by(steer: float) -> float:
    """Return the curvature (1/m) of the circle that CARLA's car drives at a steer."""
    share = REAR_AXLE_M / (FRONT_AXLE_M + REAR_AXLE_M)
    slip = math.atan(share * math.tan(STEER_GAIN_RAD * steer))
    return math.sin(slip) / REAR_AXLE_M
