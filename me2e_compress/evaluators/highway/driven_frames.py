"""Calibration frames recorded from a model's view while a driver drives."""

import itertools
import zlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from me2e_compress.base.errors import FramesError
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.driving.realtime import DT_US
from me2e_compress.evaluators.highway.controller import AnchoredPlan
from me2e_compress.evaluators.highway.observe import ObservationBuilder, cameras_of
from me2e_compress.evaluators.highway.runner import EndingRules
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.simulator.camera_rig import CameraRig
from me2e_compress.simulator.routes import EXPERT_S, Route, load_routes
from me2e_compress.simulator.scenarios.builders import stage_of
from me2e_compress.simulator.world import World

STEP_US = 500_000  # time between two frames of a scene: that between two waypoints
# Added to every seed, so that it never equals one of a set of routes
SEED_OFFSET = 1_000_000


def driven_frames(
    policy: OnnxPolicy,
    driver: OnnxPolicy,
    count: int,
    *,
    seed: int,
    scene_length: int = 16,
    done: int = 0,
    first: int = 0,
) -> Iterator[Frame]:
    """Yield what a model sees on fresh routes, every half second.

    A scene is a random stretch of one route, driven by ``driver`` without latency;
    fewer frames than ``scene_length`` if the route ends before. Its clock and CAN bus
    start anew. Scenario types alternate; none of the routes is one of the 220 that
    ship. Frames are keyed by the graph's input names, without the recurrent inputs.

    To resume, ``done`` is the number of frames that exist, in whole scenes, and
    ``first`` the index of the route of the first missing scene.

    Raises:
        FramesError: A count is below 1, or the seed below 0.
    """
    if count < 1 or scene_length < 1:
        words = f"{count} frames in scenes of {scene_length}"
        raise FramesError(f"{words}: both must be at least 1")
    if seed < 0:
        raise FramesError(f"seed {seed}: must be 0 or more")
    # Record one scene per route, from a random moment on
    routes = itertools.islice(fresh_routes(seed), first, None)
    for place, route in enumerate(routes, first):
        random = np.random.default_rng([SEED_OFFSET + seed, place])
        spare_us = EXPERT_S[route.scenario] * 1_000_000 - scene_length * STEP_US
        begin_us = int(random.integers(0, max(1, spare_us // DT_US))) * DT_US
        length = min(scene_length, count - done)
        scene = _feeds_of_scene(policy, driver, route, begin_us, length)
        for at, arrays in enumerate(scene):
            yield Frame(done, at == 0, arrays, place)
            done += 1
        if done == count:
            return


def fresh_routes(seed: int) -> Iterator[Route]:
    """Yield routes endlessly, types in random order, none of the 220 that ship."""
    shipped = {(route.scenario, route.seed) for route in load_routes()}
    types = np.random.default_rng(SEED_OFFSET + seed).permutation(sorted(EXPERT_S))
    for attempt in itertools.count():
        for scenario in map(str, types):
            drawn = seed_of(SEED_OFFSET + seed, scenario, attempt)
            if (scenario, drawn) not in shipped:
                yield propose(scenario, drawn, f"{scenario}_{attempt}")


def propose(scenario: str, seed: int, name: str) -> Route:
    """Return a route of one of the 44 types, with every parameter written out."""
    route = Route(name, scenario, seed)
    return replace(route, parameters=dict(stage_of(route).parameters))


def seed_of(seed: int, scenario: str, attempt: int) -> int:
    """Return the seed of the n-th proposal of a type, different for every type."""
    words = [seed, zlib.crc32(scenario.encode()), attempt]
    return int(np.random.SeedSequence(words).generate_state(1)[0])


def _feeds_of_scene(
    policy: OnnxPolicy, driver: OnnxPolicy, route: Route, begin_us: int, length: int
) -> Iterator[dict[str, Array]]:
    """Yield the model's feeds from a moment on, until enough or the route ends."""
    world, rules = World(route), EndingRules()
    driving, watching = (_observer_of(world, model) for model in (driver, policy))
    driver.reset(route)
    # Record every half second, from the first moment on; the driver drives
    policy.reset(route)
    scene, missing = world.scene(), length
    while missing and rules.ending(world, scene.ego.speed_mps) is None:
        since_us = scene.time_us - begin_us
        if since_us >= 0 and since_us % STEP_US == 0:
            observation = replace(watching.observe(scene), time_us=since_us)
            feeds = policy.inputs.feeds(observation)
            yield {**feeds, **(policy.first_values(feeds) if missing == length else {})}
            missing -= 1
        plan = driver.plan(driving.observe(scene))
        anchored = AnchoredPlan.of(plan, scene.ego, scene.time_us)
        world.step(anchored.control(scene.ego, scene.time_us))
        scene = world.scene()


def _observer_of(world: World, policy: OnnxPolicy) -> ObservationBuilder:
    rig = CameraRig(*policy.image_size)
    cameras = cameras_of(world, rig) if policy.needs_images else None
    return ObservationBuilder(world, policy, rig, cameras)
