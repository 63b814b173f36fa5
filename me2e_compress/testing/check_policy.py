"""Check that a policy keeps its contract, in a world of its own."""

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.base.extras import require_extra
from me2e_compress.driving.contract import (
    Answer,
    Observation,
    PedalsAndWheel,
    Policy,
    RouteInfo,
    Trajectory,
    check_answer,
)
from me2e_compress.driving.policies import POLICIES, Driver
from me2e_compress.testing.form import check_form, require

ROUTE = "HighwayExit_R2_0"
DECISIONS = 8

Answers: TypeAlias = tuple[Trajectory | PedalsAndWheel, ...]


def check_policy(driver: Driver) -> Answers:
    """Check that a driver opens a policy that keeps the contract.

    It passes :func:`check_form` and has one fingerprint. On the first decisions of a
    route that ships, each answer is a finite plan, float [6, 2] or a `Trajectory`, or
    controls in their range; the world is not stepped; and the policy gives the same
    answers after a reset, as does one that is opened anew. For a Python policy,
    ``driver`` is ``driver_named("package.module:factory")``. Returns the answers, plans
    with the times of their waypoints.

    Raises:
        VerificationError: it broke a promise; the message says which.
        EvaluationError: it cannot be opened.
        MissingExtraError: the extra ``highway`` is not installed.
    """
    # It is built from text, and has one fingerprint
    require_extra("highway", "check_policy")
    check_form(driver, POLICIES)
    name, prints = driver.name, {driver.fingerprint(), driver.fingerprint()}
    is_stable = len(prints) == 1 and all(prints)
    require(is_stable, f"{name} has no fingerprint, or more than one")
    # the same answers after a reset, and from a new policy
    policy = driver.open()
    answers, again = _answers(driver, policy), _answers(driver, policy)
    require(_equal(answers, again), f"{name} plans otherwise after a reset")
    new = _answers(driver, driver.open())
    require(_equal(answers, new), f"{name} plans otherwise when it is opened anew")
    return answers


def _equal(answers: Answers, others: Answers) -> bool:
    def array(answer: Trajectory | PedalsAndWheel) -> npt.NDArray[np.floating]:
        if isinstance(answer, PedalsAndWheel):
            return np.array(answer)
        return np.column_stack([answer.points, answer.times_s])

    pairs = zip(answers, others, strict=True)
    return all(np.array_equal(array(one), array(other)) for one, other in pairs)


def _answers(driver: Driver, policy: Policy) -> Answers:
    """Return a policy's answers to the first decisions of the route."""
    # the evaluator needs an extra that the other checks do not need
    from me2e_compress.evaluators import Drive
    from me2e_compress.evaluators.highway.drivers import image_size_of
    from me2e_compress.evaluators.highway.runner import Listeners, drive
    from me2e_compress.simulator.routes import load_routes, pick_routes
    from me2e_compress.simulator.world import World

    asked: list[tuple[World, int]] = []

    def answered() -> None:
        world, time_us = asked[-1]
        require(world.time_us == time_us, f"{driver.name} steps the world")

    # drive until the policy has answered often enough, then check the episode
    (route,) = pick_routes(load_routes(), ROUTE)
    watched = _RecordingPolicy(
        policy, policy.needs_images, policy.privileged, image_size_of(policy)
    )
    listeners = Listeners(lambda world: asked.append((world, world.time_us)), answered)
    episode = drive(route, watched, Drive(), listeners)
    require(watched.finished, f"{driver.name}: {episode.failure}")
    return tuple(check_answer(answer) for answer in watched.answers)


@dataclass
class _RecordingPolicy:
    """A policy whose first answers are recorded, and that then stops the drive."""

    policy: Policy
    needs_images: bool
    privileged: bool
    image_size: tuple[int, int]
    answers: list[Answer] = field(default_factory=list)
    finished: bool = False

    def reset(self, route: RouteInfo) -> None:
        self.policy.reset(route)

    def plan(self, observation: Observation) -> Answer:
        if len(self.answers) == DECISIONS:
            self.finished = True
            raise StopIteration
        self.answers.append(self.policy.plan(observation))
        return self.answers[-1]
