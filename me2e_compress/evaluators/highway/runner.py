"""Drive one route: the policy decides, its latency is charged, an episode results."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.answer import checked
from me2e_compress.driving.contract import (
    HostedPolicy,
    Observation,
    PedalsAndWheel,
    Policy,
    Trajectory,
)
from me2e_compress.driving.latency import DecisionFacts
from me2e_compress.driving.realtime import control_clock
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.conditions import Conditions
from me2e_compress.evaluators.highway.controller import AnchoredPlan, Controller
from me2e_compress.evaluators.highway.endings import EndingRules
from me2e_compress.evaluators.highway.episode_recorder import EpisodeRecorder
from me2e_compress.evaluators.highway.observe import ObservationBuilder, road_users
from me2e_compress.evaluators.highway.vehicle_map import control_of
from me2e_compress.metrics.episode import Ending, Episode, InferenceRecord
from me2e_compress.simulator.cameras import (
    CameraRig,
    Cameras,
    paint_texture,
)
from me2e_compress.simulator.pictures import Moment
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scene import Control, Ego, Scene
from me2e_compress.simulator.world import World

Plan = npt.NDArray[np.float64]


class PolicyFailedError(Exception):
    """A policy broke its contract; the message is the reason."""


@dataclass(frozen=True)
class Listeners:
    """Callbacks while a route is driven; none of them changes the drive.

    Args:
        on_query: Called with the world before the policy is called.
        on_answer: Called when the policy has returned.
        on_moment: Called at every frame with the data of a picture. The plan is
            relative to the ego now, None for a policy that answers controls. Makes the
            cameras render for any policy.
    """

    on_query: Callable[[World], None] = lambda world: None
    on_answer: Callable[[], None] = lambda: None
    on_moment: Callable[[Moment], None] | None = None


NO_LISTENERS = Listeners()


def drive(
    route: Route,
    policy: Policy,
    conditions: Conditions,
    listeners: Listeners = NO_LISTENERS,
) -> Episode:
    """Drive a route to its end and return the record.

    At each decision the controller turns the policy's plan and the ego's state at that
    same frame into a control; throttle, steer and brake are converted by `vehicle_map`.
    Equation 4 (or the other latency model) says when it acts and how long it is held.
    Until the first one acts, the ego coasts straight. A policy that raises, or answers
    neither finite waypoints nor valid controls, ends the route as failed.
    """
    return _Drive(route, policy, conditions, listeners).run()


class _Drive:
    def __init__(
        self, route: Route, policy: Policy, conditions: Conditions, listeners: Listeners
    ) -> None:
        self.route, self.policy, self.listeners = route, policy, listeners
        self.world = world = World(route, dt_us=conditions.dt_us)
        self.recorder, self.rules = EpisodeRecorder(world), EndingRules()
        self.clock = control_clock(
            conditions.latency_model, Control(0.0, 0.0), conditions.dt_us
        )
        self.charge = conditions.latency.on_route(route.id)
        self.controller = Controller()
        rig = CameraRig(*conditions.image_size)
        self.cameras = None
        if policy.needs_images or listeners.on_moment is not None:
            texture = paint_texture(world.roadmap, world.path.points)
            self.cameras = Cameras(texture, rig, conditions.weather)
        needed = self.cameras if policy.needs_images else None
        self.observer = ObservationBuilder(world, policy, rig, needed)
        self.plan: tuple[Ego, Plan] | None = None

    def run(self) -> Episode:
        world, ending = self.world, None
        scene = world.scene()
        # record, decide and step until a rule ends the route
        try:
            self.listeners.on_query(world)
            _reset(self.policy, self.route)
            self.listeners.on_answer()
            while ending is None:
                self.recorder.record(scene)
                if self.clock.decision_is_due:
                    self.decide(scene)
                self.show(scene)
                world.step(self.clock.advance())
                scene = world.scene()
                ending = self.rules.ending(world, scene.ego.speed_mps)
        except PolicyFailedError as failure:
            return self.recorder.episode(Ending.POLICY_FAILED, str(failure))
        # the last frame has no decision
        self.recorder.record(scene)
        self.show(scene)
        return self.recorder.episode(ending)

    def decide(self, scene: Scene) -> None:
        """Query the policy at this frame; the clock says when its answer acts."""
        # only the policy itself is timed
        observation = self.observer.observe(scene)
        self.listeners.on_query(self.world)
        begun = time.perf_counter_ns()
        answer = _ask(self.policy, observation)
        took_us = (time.perf_counter_ns() - begun) // 1_000
        self.listeners.on_answer()
        # the latency source may use the measured time
        control = self.control_by(_checked(answer), scene)
        facts = DecisionFacts(took_us, road_users(scene), *_host_work(self.policy))
        latency_us = self.charge(facts)
        self.recorder.decisions.append(InferenceRecord(scene.time_us, latency_us))
        self.clock.decide(control, latency_us)

    def control_by(self, answer: Trajectory | PedalsAndWheel, scene: Scene) -> Control:
        if isinstance(answer, PedalsAndWheel):
            self.plan = None
            return control_of(answer, scene.ego.length)
        self.plan = scene.ego, np.asarray(answer.points, np.float64)
        anchored = AnchoredPlan.of(answer, scene.ego, scene.time_us)
        return self.controller.control(anchored, scene.ego, scene.time_us)

    def show(self, scene: Scene) -> None:
        """Render this frame for the listener that draws pictures."""
        if self.listeners.on_moment is not None and self.cameras is not None:
            images = self.cameras.render(scene)
            plan = None if self.plan is None else _seen_from(scene.ego, *self.plan)
            self.listeners.on_moment(Moment(scene, images, plan, self.world.events))


def _seen_from(ego: Ego, planned_at: Ego, plan: Plan) -> Plan:
    """Convert the waypoints of an earlier ego frame to the present one."""
    cos, sin = math.cos(planned_at.heading), math.sin(planned_at.heading)
    world = plan @ np.array([[cos, sin], [-sin, cos]]) + (planned_at.x, planned_at.y)
    cos, sin = math.cos(ego.heading), math.sin(ego.heading)
    return np.asarray((world - (ego.x, ego.y)) @ np.array([[cos, -sin], [sin, cos]]))


def _reset(policy: Policy, route: Route) -> None:
    try:
        policy.reset(route)
    except Exception as error:
        raise _failure(error) from error


def _ask(policy: Policy, observation: Observation) -> object:
    """Call the policy; whatever it raises is its failure, not ours."""
    try:
        return policy.plan(observation)
    except Exception as error:
        raise _failure(error) from error


def _host_work(policy: Policy) -> tuple[int, int]:
    """Return iterations and cells of the policy's host stage; zeros without one."""
    if not isinstance(policy, HostedPolicy):
        return 0, 0
    return policy.host_iterations, policy.host_cells


def _failure(error: Exception) -> PolicyFailedError:
    words = " ".join(str(error).split())
    return PolicyFailedError(
        f"{type(error).__name__}: {words}" if words else repr(error)
    )


def _checked(answer: object) -> Trajectory | PedalsAndWheel:
    try:
        return checked(answer)
    except EvaluationError as error:
        raise PolicyFailedError(str(error)) from error
