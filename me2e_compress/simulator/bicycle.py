"""The kinematic bicycle of highway-env, solved for the steering angle.

highway-env refers its bicycle to the centre of the car with both axles half a length
away (`highway_env.vehicle.kinematics.Vehicle.step`): with front wheel angle d the
centre moves along ``heading + b``, not along the heading, where the slip angle b has
``tan b = tan d / 2``, and the heading turns with curvature ``sin b / (length / 2)``.
"""

import math

MAX_STEERING_RAD = 0.6  # largest angle of the ego's front wheels


def slip_of(steering_rad: float) -> float:
    """Return the slip angle (rad) at the centre for a front wheel angle (rad)."""
    return math.atan(math.tan(steering_rad) / 2)


def steering_of(slip_rad: float) -> float:
    """Return the front wheel angle (rad) for a slip angle, clipped to its range."""
    wanted = math.atan(2 * math.tan(slip_rad))
    return min(max(wanted, -MAX_STEERING_RAD), MAX_STEERING_RAD)


def curvature_of(steering_rad: float, length_m: float) -> float:
    """Return the curvature (1/m) of the centre's circle for a wheel angle (rad)."""
    return math.sin(slip_of(steering_rad)) / (length_m / 2)


def advance(
    x: float,
    y: float,
    heading: float,
    steering_rad: float,
    travel_m: float,
    length_m: float,
) -> tuple[float, float, float]:
    """Return the pose (x, y, heading) after ``travel_m`` at a fixed steering angle."""
    slip = slip_of(steering_rad)
    turn = travel_m * math.sin(slip) / (length_m / 2)
    chord = travel_m * math.sin(turn / 2) / (turn / 2) if abs(turn) > 1e-6 else travel_m
    course = heading + slip + turn / 2
    return x + chord * math.cos(course), y + chord * math.sin(course), heading + turn


def steering_through(forward_m: float, left_m: float, length_m: float) -> float:
    """Return the wheel angle (rad) whose circle passes a point of the ego frame."""
    # The chord to a point at distance D leaves the heading by the slip angle b plus
    # half the turn: bearing = b + asin(D sin b / length). Ignoring b (2 left / D^2 as
    # the curvature) answers 2.25 times too much at D = 4 m for a 5 m car, which then
    # cuts into every bend.
    distance = max(math.hypot(forward_m, left_m), 0.1)
    bearing = math.atan2(left_m, max(forward_m, 0.1))
    steepest = slip_of(MAX_STEERING_RAD)
    reach = min(steepest, math.asin(min(0.99, 0.99 * length_m / distance)))
    # The right side grows with b: Newton's method from the linear solution
    slip = min(max(bearing / (1 + distance / length_m), -reach), reach)
    for _ in range(4):
        half_turn = distance * math.sin(slip) / length_m
        error = slip + math.asin(half_turn) - bearing
        slope = 1 + distance / length_m * math.cos(slip) / math.sqrt(1 - half_turn**2)
        slip = min(max(slip - error / slope, -reach), reach)
    return steering_of(slip)
