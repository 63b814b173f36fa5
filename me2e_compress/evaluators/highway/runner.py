"""Drive one route: the policy decides, its latency is charged, an episode results.

A route ends by the rules of the CARLA leaderboard, as Bench2Drive sets them.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import (
    HostedPolicy,
    PedalsAndWheel,
    Policy,
    check_answer,
)
from me2e_compress.driving.latency import DecisionFacts
from me2e_compress.driving.realtime import ControlClock
from me2e_compress.evaluators.contract import Drive
from me2e_compress.evaluators.highway.controller import AnchoredPlan, control_of
from me2e_compress.evaluators.highway.drivers import image_size_of
from me2e_compress.evaluators.highway.episode_recorder import EpisodeRecorder
from me2e_compress.evaluators.highway.observe import (
    ObservationBuilder,
    cameras_of,
    road_users,
)
from me2e_compress.metrics.episode import Ending, Episode, InferenceRecord
from me2e_compress.metrics.route_scores import BLOCKED_SPEED_MPS, BLOCKED_US
from me2e_compress.simulator.camera_rig import CameraRig
from me2e_compress.simulator.pictures import Moment
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scene import Control, Ego, Scene
from me2e_compress.simulator.world import World

TIMEOUT_US = 200_000_000  # 4000 ticks of 50 ms; the leaderboard's own limits are longer
DEVIATION_M = 30.0
ASTRAY_M = 15.0
ASTRAY_SHARE = 0.3


@dataclass
class EndingRules:
    """Decides when one route is over; constants of Bench2Drive's atomic_criteria.py.

    * the goal is reached, or the ego collides: the world itself ends there. CARLA
      drives on after a collision, so its driving scores multiply more penalties;
    * deviation: 30 m from the route, or more than 30 % of its length driven at least 15
      m away from it;
    * blocked: at most 0.1 m/s for 60 s;
    * timed out: 200 s.
    """

    _stopped_at_us: int | None = field(default=None, init=False)
    _astray_m: float = field(default=0.0, init=False)
    _last_us: int = field(default=0, init=False)

    def ending(self, world: World, speed_mps: float) -> Ending | None:
        """Return why the route is over, or None; call it after every step."""
        if world.reason is not None:
            return world.reason
        # Far from the route, or for long
        away_m, now_us = abs(world.lateral_m), world.time_us
        if away_m >= ASTRAY_M:
            self._astray_m += speed_mps * (now_us - self._last_us) / 1e6
        self._last_us = now_us
        if away_m >= DEVIATION_M or self._astray_m > ASTRAY_SHARE * world.path.goal_m:
            return Ending.DEVIATION
        # Standing for long
        if speed_mps > BLOCKED_SPEED_MPS:
            self._stopped_at_us = None
        elif self._stopped_at_us is None:
            self._stopped_at_us = now_us
        elif now_us - self._stopped_at_us >= BLOCKED_US:
            return Ending.BLOCKED
        return Ending.TIMEOUT if now_us >= TIMEOUT_US else None


Plan = npt.NDArray[np.float64]
T = TypeVar("T")


class PolicyFailedError(Exception):
    """A policy broke its contract; the message is the reason."""


@dataclass(frozen=True)
class Listeners:
    """Callbacks while a route is driven; none of them changes the drive."""

    # Called with the world before the policy is called
    on_query: Callable[[World], None] = lambda world: None
    on_answer: Callable[[], None] = lambda: None  # called when the policy has returned
    # Called at every frame with the data of a picture. The plan is relative to the ego
    # now, None for a policy that answers controls. Makes the cameras render for any
    # policy.
    on_moment: Callable[[Moment], None] | None = None


def drive(
    route: Route, policy: Policy, conditions: Drive, listeners: Listeners = Listeners()
) -> Episode:
    """Drive a route to its end and return the record.

    At each decision the controller turns the policy's plan and the ego's state at that
    same frame into a control; throttle, steer and brake are converted as CARLA's car
    would answer them.
    Equation 4 (or the other latency model) says when it acts and how long it is held.
    Until the first one acts, the ego coasts straight. A policy that raises, or answers
    neither finite waypoints nor valid controls, ends the route as failed.
    """
    return _Drive(route, policy, conditions, listeners).run()


class _Drive:
    def __init__(
        self, route: Route, policy: Policy, conditions: Drive, listeners: Listeners
    ) -> None:
        # The world, its record, and the rules of latency
        self.route, self.policy, self.listeners = route, policy, listeners
        self.hosted = policy if isinstance(policy, HostedPolicy) else None
        self.world = world = World(route, dt_us=conditions.dt_us)
        self.recorder, self.rules = EpisodeRecorder(world), EndingRules()
        coast, model = Control(0.0, 0.0), conditions.latency_model
        self.clock = ControlClock(coast, conditions.dt_us, model)
        self.charge = conditions.latency.on_route(route.id)
        # Cameras render for a policy or a picture only
        rig = CameraRig(*image_size_of(policy))
        self.cameras = None
        if policy.needs_images or listeners.on_moment is not None:
            self.cameras = cameras_of(world, rig, conditions.weather)
        self.observer = ObservationBuilder(world, policy, rig, self.cameras)
        self.plan: tuple[Ego, Plan] | None = None

    def run(self) -> Episode:
        world, ending = self.world, None
        scene = world.scene()
        # Record, decide and step until a rule ends the route
        try:
            self.listeners.on_query(world)
            _call_policy(lambda: self.policy.reset(self.route))
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
        # The last frame has no decision
        self.recorder.record(scene)
        self.show(scene)
        return self.recorder.episode(ending)

    def decide(self, scene: Scene) -> None:
        """Query the policy at this frame; the clock says when its answer acts."""
        # Time the policy alone
        observation = self.observer.observe(scene)
        self.listeners.on_query(self.world)
        begun = time.perf_counter_ns()
        answer = _call_policy(lambda: self.policy.plan(observation))
        took_us = (time.perf_counter_ns() - begun) // 1_000
        self.listeners.on_answer()
        # Convert its answer; the latency source may use the measured time
        try:
            valid = check_answer(answer)
        except EvaluationError as error:
            raise PolicyFailedError(str(error)) from error
        if isinstance(valid, PedalsAndWheel):
            self.plan = None
            control = control_of(valid, scene.ego.length)
        else:
            self.plan = scene.ego, np.asarray(valid.points, np.float64)
            anchored = AnchoredPlan.of(valid, scene.ego, scene.time_us)
            control = anchored.control(scene.ego, scene.time_us)
        # Charge the latency, which may depend on the work of a host stage
        work = 0, 0
        if self.hosted is not None:
            work = self.hosted.host_iterations, self.hosted.host_cells
        latency_us = self.charge(DecisionFacts(took_us, road_users(scene), *work))
        self.recorder.decisions.append(InferenceRecord(scene.time_us, latency_us))
        self.clock.decide(control, latency_us)

    def show(self, scene: Scene) -> None:
        """Render this frame for the listener that draws pictures."""
        if self.listeners.on_moment is not None and self.cameras is not None:
            images = self.cameras.render(scene)
            plan = None
            if self.plan is not None:
                planned_at, points = self.plan
                plan = scene.ego.seen(*planned_at.placed(points).T)
            self.listeners.on_moment(Moment(scene, images, plan, self.world.events))


def _call_policy(call: Callable[[], T]) -> T:
    """Call the policy; whatever it raises is its failure, not ours."""
    try:
        return call()
    except Exception as error:
        words = " ".join(str(error).split())
        reason = f"{type(error).__name__}: {words}" if words else repr(error)
        raise PolicyFailedError(reason) from error
