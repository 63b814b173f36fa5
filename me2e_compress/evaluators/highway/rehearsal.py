"""Drive a route once without cameras, latency or bookkeeping, and say how it went."""

from dataclasses import dataclass

import numpy as np

from me2e_compress.evaluators.base import CAN_BUS_SIZE, Observation, Policy
from me2e_compress.evaluators.highway.controller import AnchoredPlan, Controller
from me2e_compress.evaluators.highway.routes import Route
from me2e_compress.evaluators.highway.world import INFRACTIONS, EndReason, EventKind
from me2e_compress.evaluators.highway.world.world import World

TIME_LIMIT_S = 90.0
"""A route of 150 m at 12 m/s takes 13 s; the longest admitted waits add 40 s."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """How one drive of one route went.

    Attributes:
        infractions: Kinds of infractions in order, none repeated.
        completed: Whether the goal was reached.
        triggered: Whether the scenario's event happened.
        actors_crashed: Whether two actors collided: a fault of the scenario.
        seconds: Simulated time at the end.
    """

    infractions: tuple[EventKind, ...]
    completed: bool
    triggered: bool
    actors_crashed: bool
    seconds: float

    @property
    def solved(self) -> bool:
        """Goal reached and nothing done wrong."""
        return self.completed and not self.infractions


def rehearse(route: Route, policy: Policy, *, to_the_end: bool = True) -> Rehearsal:
    """Drive a route with a privileged policy that decides at every frame.

    Args:
        route: What to drive.
        policy: A privileged policy: it sees the world, no images.
        to_the_end: Go on after infractions that do not end a route.
    """
    world, controller = World(route), Controller()
    policy.reset(route)
    while not world.done and world.time_us < TIME_LIMIT_S * 1e6:
        scene = world.scene()
        plan = policy.plan(_observation(world))
        anchored = AnchoredPlan.of(plan, scene.ego, world.time_us)
        world.step(controller.control(anchored, scene.ego, world.time_us))
        if not to_the_end and any(e.kind in INFRACTIONS for e in world.events):
            break
    kinds = [event.kind for event in world.events]
    return Rehearsal(
        tuple(dict.fromkeys(kind for kind in kinds if kind in INFRACTIONS)),
        world.reason is EndReason.GOAL,
        EventKind.TRIGGER in kinds,
        EventKind.ACTOR_COLLISION in kinds,
        world.time_us / 1e6,
    )


def _observation(world: World) -> Observation:
    scene = world.scene()
    return Observation(
        world.time_us,
        None,
        np.zeros((6, 4, 4), np.float32),
        np.zeros(CAN_BUS_SIZE, np.float32),
        int(world.path.command_at(world.ego_s)),
        scene.ego.speed_mps,
        scene,
        world,
    )
