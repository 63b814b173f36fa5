"""The world as a gymnasium environment.

    import gymnasium
    import me2e_compress.simulator.world.environment  # registers the id

    env = gymnasium.make("me2e_compress/Highway-v0")

For agents that learn from gymnasium's interface; the evaluator steps `World` itself.
"""

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from me2e_compress.errors import EvaluationError
from me2e_compress.simulator.bicycle import MAX_STEERING_RAD
from me2e_compress.simulator.routes import Route, load_routes
from me2e_compress.simulator.scene import Control
from me2e_compress.simulator.traffic.bodies import ACCELERATION_RANGE_MPS2
from me2e_compress.simulator.world.world import DT_US, EndReason, World

ENVIRONMENT = "me2e_compress/Highway-v0"
LOOKED_AT = 8
"""Nearest actors in the observation."""
AHEAD_M = (5.0, 10.0, 20.0, 40.0)
"""Where the observation samples the route."""
REACH_M = 100.0
MOST_SECONDS = 120.0
Observed = npt.NDArray[np.float32]


class HighwayEnv(gymnasium.Env[Observed, npt.NDArray[np.float32]]):
    """One route an episode.

    * action [2] float32 in [-1, 1]: acceleration (-8 to 4 m/s2; 0 is -2) and front
      wheel angle (positive left, at most 0.6 rad);
    * observation [64] float32, clipped to +-100: speed, acceleration, yaw rate, wheel
      angle, offset from the route, metres to go; the route at 5, 10, 20 and 40 m (x
      forward, y left, ego frame); the 8 nearest actors (x, y, cosine and sine of the
      heading against the ego's, speed, 1 if there), the rest 0;
      red light or sign ahead (metres to its line, 100 if none, then 1 if it is red);
    * reward: metres of new progress, less 50 at a collision;
    * terminated at the goal or a collision, truncated after 120 s.

    Args:
        routes: Episodes to choose from; the shipped 220 by default.
        dt_us: Frame length.
    """

    def __init__(
        self, routes: Sequence[Route] | None = None, dt_us: int = DT_US
    ) -> None:
        self._routes = tuple(load_routes() if routes is None else routes)
        self._dt_us = dt_us
        self._world: World | None = None
        size = 6 + 2 * len(AHEAD_M) + 6 * LOOKED_AT + 2
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = gymnasium.spaces.Box(
            -REACH_M, REACH_M, (size,), np.float32
        )

    @property
    def world(self) -> World:
        """The world of the present episode."""
        if self._world is None:
            raise EvaluationError("the environment has not been reset yet")
        return self._world

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Begin a route: ``options["route"]`` by id, or one drawn by the seed."""
        super().reset(seed=seed)
        wanted = None if options is None else options.get("route")
        if wanted is None:
            route = self._routes[int(self.np_random.integers(len(self._routes)))]
        else:
            named = {route.id: route for route in self._routes}
            if wanted not in named:
                raise EvaluationError(f"no route {wanted!r}; there are {len(named)}")
            route = named[wanted]
        self._world = World(route, dt_us=self._dt_us)
        return self._observe(), {"route": route.id, "scenario": route.scenario}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Advance by one frame."""
        world, before = self.world, self.world.progress_m
        low, high = ACCELERATION_RANGE_MPS2
        push = (float(action[0]) + 1) / 2
        wheel = float(action[1]) * MAX_STEERING_RAD
        world.step(Control(low + push * (high - low), wheel))
        reward = world.progress_m - before
        reward -= 50.0 * (world.reason is EndReason.COLLISION)
        late = world.time_us >= MOST_SECONDS * 1e6
        info = {"events": [event.kind.value for event in world.events]}
        return self._observe(), float(reward), world.done, late, info

    def _observe(self) -> Observed:
        world, scene = self.world, self.world.scene()
        ego = scene.ego
        cos, sin = math.cos(ego.heading), math.sin(ego.heading)
        values = [
            ego.speed_mps,
            ego.acceleration_mps2,
            ego.yaw_rate_radps,
            ego.steering_rad,
            world.lateral_m,
            world.path.goal_m - world.ego_s,
        ]
        xs, ys, _ = world.path.at(world.ego_s + np.array(AHEAD_M))
        for x, y in zip(xs - ego.x, ys - ego.y, strict=True):
            values += [cos * x + sin * y, cos * y - sin * x]
        near = sorted(
            (math.hypot(a.x - ego.x, a.y - ego.y), a.id, a) for a in scene.actors
        )
        for _, _, actor in near[:LOOKED_AT]:
            x, y, turn = actor.x - ego.x, actor.y - ego.y, actor.heading - ego.heading
            values += [cos * x + sin * y, cos * y - sin * x]
            values += [math.cos(turn), math.sin(turn), actor.speed_mps, 1.0]
        values += [0.0] * (6 * max(0, LOOKED_AT - len(near)))
        phases = [p for p in world.privileged().phases if p.line_s > world.ego_s]
        ahead = min(phases, key=lambda phase: phase.line_s, default=None)
        to_line = REACH_M if ahead is None else ahead.line_s - world.ego_s
        values += [to_line, float(ahead is not None and ahead.state == "red")]
        return np.clip(np.array(values, np.float32), -REACH_M, REACH_M)


gymnasium.register(ENVIRONMENT, entry_point=f"{__name__}:{HighwayEnv.__name__}")
