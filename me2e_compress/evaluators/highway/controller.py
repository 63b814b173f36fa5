"""Waypoints, or pedals and wheel, to acceleration and steering.

A plan is tracked in the world, from the pose at which it was computed, along a smooth
curve that starts on the ego's course. Steering is pursuit with the circle of the real
bicycle model; speed follows from the plan's positions half a second and a second from
now, corrected for the lag of brakes and engine.

Three faults make waypoint trackers leave the road in roundabouts, even with perfect
waypoints (measured on highway-env's own roundabout, 12 seeds, the same expert, same 3 m
lookahead, replanned every frame / every fifth frame):

* Pursuit that takes the heading for the direction of travel. In a bend the centre of
  highway-env's bicycle moves along heading + slip (7 degrees at a radius of 20 m), so
  pursuit sees every target too far inside and steers up to 2.25 times too much: 0 / 1
  of 12 routes survive. With the exact circle (`bicycle.steering_through`) 12 / 12 do.
* Plans that start flat. A plan that returns to the centre line with zero slope at the
  ego starts anew at every replan and never returns; one that starts along the current
  course does. Mean offset 0.16 m against 0.08 m.
* A reference that no car can follow: two kinks of 46 degrees, at entry and exit, where
  the lane centres do not meet. The best tracker is 1.5 m off there. Here the routes are
  smooth instead.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.interpolate import CubicSpline

from me2e_compress.driving.contract import PedalsAndWheel, Plan, Trajectory, with_times
from me2e_compress.simulator.bicycle import (
    advance,
    slip_of,
    steering_of,
    steering_through,
)
from me2e_compress.simulator.plane_geometry import Floats, resample
from me2e_compress.simulator.scene import Control, Ego
from me2e_compress.simulator.traffic.bodies import (
    ACCELERATION_LAG_S,
    ACCELERATION_RANGE_MPS2,
    STEERING_LAG_S,
)

# Lookahead of the pursuit: seconds of travel, and metres at walking pace
LOOKAHEAD_S, SHORTEST_LOOKAHEAD_M = 0.5, 3.0
# Seconds ahead at which the planned positions set the acceleration
AHEAD_S = (0.5, 1.0)
MIN_STEP_M = 0.3  # waypoints nearer than this to their predecessor give no direction
STATION_M = 0.25  # spacing of the curve that is tracked
BEYOND_M = 20.0  # straight extension of the curve, for lookahead beyond a short plan


@dataclass(frozen=True, eq=False)
class AnchoredPlan:
    """A plan in the world frame, fixed at the pose where it was computed.

    The curve passes smoothly through the n waypoints, sampled every 0.25 m, with a
    straight extension of 20 m.
    """

    time_us: int
    curve: Floats  # (points, 2)
    travel_m: Floats  # (n + 1,) metres at the start and at the waypoints
    times_s: Floats  # (n + 1,) seconds

    @classmethod
    def of(cls, plan: Plan | Trajectory, ego: Ego, time_us: int) -> Self:
        """Anchor a plan (ego frame) at the ego's pose."""
        trajectory = with_times(plan)
        waypoints = np.asarray(trajectory.points, np.float64)
        times = np.concatenate([[0.0], trajectory.times_s])
        knots, travel = _advance_only(np.vstack([np.zeros((1, 2)), waypoints]))
        local = _smooth(knots, slip_of(ego.steering_rad))
        return cls(time_us, ego.placed(local), travel, times)

    def nearest(self, x: float, y: float) -> float:
        """Return the arc length (m) of the curve point nearest to a position."""
        (start_x, start_y), (step_x, step_y), square = self._chords
        away_x, away_y = x - start_x, y - start_y
        # Project the position on every chord, within its ends
        share = ((away_x * step_x + away_y * step_y) / square).clip(0.0, 1.0)
        miss_x, miss_y = away_x - share * step_x, away_y - share * step_y
        i = int((miss_x * miss_x + miss_y * miss_y).argmin())
        return (i + float(share[i])) * STATION_M

    @cached_property
    def _chords(self) -> tuple[Floats, Floats, Floats]:
        """Starts [2, M - 1] of the curve's chords, their steps, and squared lengths."""
        steps = self.curve[1:] - self.curve[:-1]
        square = steps[:, 0] * steps[:, 0] + steps[:, 1] * steps[:, 1]
        return self.curve[:-1].T, steps.T, square

    def point(self, arc_m: float) -> tuple[float, float]:
        """Return the position at an arc length."""
        stations = np.arange(len(self.curve)) * STATION_M
        x, y = (np.interp(arc_m, stations, column) for column in self.curve.T)
        return float(x), float(y)

    def travel_at(self, seconds: float) -> float:
        """Return metres travelled after seconds; after the end at the last speed."""
        times = self.times_s
        last_speed = (self.travel_m[-1] - self.travel_m[-2]) / (times[-1] - times[-2])
        beyond = max(seconds - times[-1], 0.0) * last_speed
        return float(np.interp(seconds, times, self.travel_m) + beyond)

    def control(self, ego: Ego, time_us: int) -> Control:
        """Return the control that follows the plan from the ego's present state.

        It is computed once per decision and does not steer between two of them.
        """
        # Acceleration: the least-squares fit to the positions in 0.5 s and 1 s
        age_s = (time_us - self.time_us) / 1e6
        here, speed = self.nearest(ego.x, ego.y), ego.speed_mps
        lag, fit, weight = ACCELERATION_LAG_S, 0.0, 0.0
        for ahead in AHEAD_S:
            # Distance lost to the lag, distance coasted, distance per commanded m/s2
            late = lag * (ahead - lag) + lag**2 * math.exp(-ahead / lag)
            free = speed * ahead + ego.acceleration_mps2 * late
            gain = ahead**2 / 2 - late
            fit += gain * (self.travel_at(age_s + ahead) - here - free)
            weight += gain * gain
        low, high = ACCELERATION_RANGE_MPS2
        acceleration = min(max(fit / weight, low), high)
        # Steering: from where the ego is once the wheels have turned
        travel, pose = speed * STEERING_LAG_S, (ego.x, ego.y, ego.heading)
        x, y, heading = advance(*pose, ego.steering_rad, travel, ego.length)
        # To the point of the curve one lookahead further, in the ego's frame then
        lookahead = max(SHORTEST_LOOKAHEAD_M, LOOKAHEAD_S * speed)
        target_x, target_y = self.point(self.nearest(x, y) + lookahead)
        cos, sin = math.cos(heading), math.sin(heading)
        forward = cos * (target_x - x) + sin * (target_y - y)
        left = cos * (target_y - y) - sin * (target_x - x)
        return Control(acceleration, steering_through(forward, left, ego.length))


def _advance_only(points: Floats) -> tuple[Floats, Floats]:
    """Drop the waypoints [N, 2] that do not advance.

    The waypoints of a plan that stops lie around one place: they must neither bend the
    curve nor add to its length. Returns [K, 2] knots, and [N] metres travelled.
    """
    knots, travel, arc = [points[0]], [0.0], 0.0
    direction = np.array([1.0, 0.0])
    for point in points[1:]:
        step = point - knots[-1]
        length, forward = float(np.hypot(*step)), float(step @ direction)
        # A step backwards, or a tiny one, counts at most its way forward
        if length >= MIN_STEP_M and forward > 0:
            direction, arc = step / length, arc + length
            knots.append(point)
            travel.append(arc)
        else:
            travel.append(max(travel[-1], arc + min(forward, MIN_STEP_M)))
    return np.array(knots), np.array(travel)


def _smooth(knots: Floats, course: float) -> Floats:
    """Return [M, 2] points every 0.25 m: cubic through the knots, then straight.

    ``course`` (rad) is the direction of travel at the first knot.
    """
    # A spline that starts along the course and ends straight
    tangent = np.array([math.cos(course), math.sin(course)])
    curve = knots[:1]
    if len(knots) > 1:
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(knots, axis=0).T))])
        spline = CubicSpline(arc, knots, bc_type=((1, tangent), (2, np.zeros(2))))
        fine = np.append(np.arange(0.0, arc[-1], STATION_M / 2), arc[-1])
        curve, tangent = spline(fine), spline(arc[-1], 1)
        tangent = tangent / np.hypot(*tangent)
    # The straight extension, and even spacing
    beyond = curve[-1] + BEYOND_M * tangent
    return resample(np.vstack([curve, beyond]), STATION_M)


STEER_GAIN_RAD = 0.36848336
# World on Rails: wheel angle of a full steer, axles from the centre
FRONT_AXLE_M, REAR_AXLE_M = -0.090769015, 1.4178275


def control_of(pedals: PedalsAndWheel, length_m: float) -> Control:
    """Convert CARLA's throttle, brake and steer to the control of this ego.

    Full pedals are the limits of the ego's engine and brakes, as in CARLA: throttle 4
    m/s2, brake 8 m/s2, both together their difference; with neither the speed stays.

    A steer (to the right positive) gives the circle that CARLA's car would drive, by
    the kinematic bicycle that World on Rails (Chen, Koltun and Kraehenbuehl 2021)
    fitted to CARLA and TransFuser and its successors use. A full steer is a circle of
    3.7 m there; the wheels of this ego turn to one of 7.7 m, so a steer beyond 0.47
    changes nothing.
    """
    braking, thrust = ACCELERATION_RANGE_MPS2
    curvature = curvature_by(-pedals.steer)
    sine = min(max(curvature * length_m / 2, -1.0), 1.0)
    acceleration = pedals.throttle * thrust + pedals.brake * braking
    return Control(acceleration, steering_of(math.asin(sine)))


def curvature_by(steer: float) -> float:
    """Return the curvature (1/m) of the circle that CARLA's car drives at a steer."""
    share = REAR_AXLE_M / (FRONT_AXLE_M + REAR_AXLE_M)
    slip = math.atan(share * math.tan(STEER_GAIN_RAD * steer))
    return math.sin(slip) / REAR_AXLE_M
