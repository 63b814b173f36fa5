"""Check that a policy keeps its contract, in a world of its own."""

from dataclasses import dataclass, field

import numpy as np

from me2e_compress.driving.contract import Observation, Plan, Policy, RouteInfo
from me2e_compress.driving.policies import POLICIES, Driver
from me2e_compress.errors import VerificationError
from me2e_compress.testing.form import check_form

ROUTE = "HighwayExit_0"
DECISIONS = 8


def check_policy(driver: Driver) -> tuple[Plan, ...]:
    """Check that a driver opens a policy that keeps the contract.

    It has the form of :func:`check_form` and one fingerprint. On the first decisions
    of a route that ships, each plan is a finite float array [6, 2]; the world is not
    stepped; the same policy plans the same after a reset, and so does one that is
    opened anew.

    Args:
        driver: what opens the policy.

    Returns:
        The plans.

    Raises:
        VerificationError: it broke a promise; the message says which.
        EvaluationError: it cannot be opened.
        MissingExtraError: the extra ``highway`` is not installed.
    """
    check_form(driver, POLICIES)
    if not driver.fingerprint() or driver.fingerprint() != driver.fingerprint():
        raise VerificationError(f"{driver.name} has no fingerprint, or more than one")
    policy = driver.open()
    plans, again = _plans(driver, policy), _plans(driver, policy)
    if not np.array_equal(plans, again):
        raise VerificationError(f"{driver.name} plans otherwise after a reset")
    if not np.array_equal(plans, _plans(driver, driver.open())):
        raise VerificationError(f"{driver.name} plans otherwise when it is opened anew")
    return plans


def _plans(driver: Driver, policy: Policy) -> tuple[Plan, ...]:
    """Drive the beginning of the route."""
    # the evaluator needs an extra that the other checks do not need
    from me2e_compress.evaluators.highway.conditions import Conditions
    from me2e_compress.evaluators.highway.drivers import image_size_of
    from me2e_compress.evaluators.highway.runner import Listeners, drive
    from me2e_compress.simulator.routes import load_routes, pick_routes
    from me2e_compress.simulator.world import World

    asked: list[tuple[World, int]] = []

    def answered() -> None:
        world, time_us = asked[-1]
        if world.time_us != time_us:
            raise VerificationError(f"{driver.name} steps the world")

    (route,) = pick_routes(load_routes(), ROUTE)
    watched = _Watched(policy, policy.needs_images, policy.privileged)
    listeners = Listeners(lambda world: asked.append((world, world.time_us)), answered)
    conditions = Conditions(image_size=image_size_of(policy))
    episode = drive(route, watched, conditions, listeners)
    if len(watched.plans) < DECISIONS or not watched.enough:
        raise VerificationError(f"{driver.name}: {episode.failure}")
    return tuple(watched.plans)


@dataclass
class _Watched:
    """A policy whose first plans are kept, and that then gives up."""

    policy: Policy
    needs_images: bool
    privileged: bool
    plans: list[Plan] = field(default_factory=list)
    enough: bool = False

    def reset(self, route: RouteInfo) -> None:
        self.policy.reset(route)

    def plan(self, observation: Observation) -> Plan:
        if len(self.plans) == DECISIONS:
            self.enough = True
            raise StopIteration
        self.plans.append(self.policy.plan(observation))
        return self.plans[-1]
