"""Our agents beside Bench2Drive's own: the same sensors, the same numbers?

    python -m benchmarks.bench_agents BENCH2DRIVE ZOO [--frames 40]

BENCH2DRIVE and ZOO are clones of Thinklab-SJTU/Bench2Drive and of branch uniad/vad of
Thinklab-SJTU/Bench2DriveZoo; neither is part of this project. Their AutonomousAgent,
AgentWrapper, SensorInterface, VadAgent, PIDController and RoutePlanner run as they are;
CARLA, srunner, mmcv and the network are not there (`benchmarks.zoo_stubs`). It needs
torch.

Prints the largest difference of everything that `GraphAgent` makes of the sensors and
of the controls, over all frames, and whether the VAD agent in `RealTimeAgent` acts in
every frame as the rule says.
"""

import argparse
import contextlib
import importlib
import io
import math
import os
import sys
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import onnx

from benchmarks.zoo_stubs import Network, RoadOption, install
from me2e_compress.driving.adapter import Axes
from me2e_compress.driving.realtime import HeldControl
from me2e_compress.driving.waypoint_pid import PidOptions, WaypointPid
from me2e_compress.evaluators.carla import graph_agent, real_time
from tests.evaluators.carla.small_leaderboard import SAVE_NAME, World, gps_of

LIDAR = Axes.RIGHT_FORWARD
ROUTE = [
    (float(x), 0.01 * x * x, RoadOption.RIGHT if x > 40 else RoadOption.LANEFOLLOW)
    for x in range(120)
]
GRAPH = """<ir_version: 8, opset_import: ["" : 17]>
    driver (float[1, 6, 3, 900, 1600] img) => (float[1, 6, 2] plan) {
        mean = ReduceMean <axes = [2, 3, 4], keepdims = 0> (img)
        tall = Unsqueeze (mean, last)
        plan = Concat <axis = 2> (tall, tall)
    }"""
FPS = 5.0


class Noisy(World):
    """Camera pictures with texture, and an IMU that shakes."""

    random = np.random.default_rng(0)

    def _sense(self, spec: dict[str, Any]) -> Any:
        found = super()._sense(spec)
        if spec["type"] == "sensor.camera.rgb":
            coarse = self.random.integers(0, 256, (9, 16, 4), np.uint8)
            rows, columns = -(-spec["height"] // 9), -(-spec["width"] // 16)
            large = np.kron(coarse, np.ones((rows, columns, 1), np.uint8))
            return large[: spec["height"], : spec["width"]].astype(np.uint8)
        if spec["type"] == "sensor.other.imu":
            found[:6] += self.random.normal(0.0, 1.0, 6)
        return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bench2drive", type=Path)
    parser.add_argument("zoo", type=Path)
    parser.add_argument("--frames", type=int, default=40)
    given = parser.parse_args()
    world, network = Noisy(speed=6.0), Network()
    with tempfile.TemporaryDirectory() as name:
        # the Zoo's agent reads these
        saved = {"IS_BENCH2DRIVE": "True", "SAVE_PATH": name, "ROUTES": "routes.xml"}
        os.environ.update(saved)
        roots = (given.bench2drive / "leaderboard", given.zoo / "team_code")
        sys.path[:0] = [str(root.resolve()) for root in roots]
        package = ModuleType("Bench2DriveZoo")
        package.__path__ = [str(given.zoo.resolve())]
        sys.modules["Bench2DriveZoo"] = package
        install(world, network)
        with contextlib.redirect_stdout(io.StringIO()):  # a line a tick
            found = list(observations(world, network, Path(name), given.frames))
            acts = wrapped(world, Path(name), given.frames)
    for part in found[0]:
        print(f"{part:10} {max(each[part] for each in found):.3g}")
    for part, worst in controls(1000).items():
        print(f"{part:10} {worst:.3g}")
    print(f"in force   {acts} frames of {given.frames} otherwise than the rule says")


def plan() -> tuple[Any, Any]:
    """Name the route both ways, as the leaderboard does."""
    gps, places = [], []
    for x, y, option in ROUTE:
        latitude, longitude = gps_of(x, y)
        gps.append(({"lat": latitude, "lon": longitude, "z": 0.0}, option))
        at = SimpleNamespace(x=x, y=y, z=0.0)
        at.distance = lambda to, x=x, y=y: math.hypot(to.x - x, to.y - y)
        places.append((SimpleNamespace(location=at), option))
    return gps, places


def started(module: Any, conf: str, world: World) -> tuple[Any, Any]:
    """Set an agent up as Bench2Drive's evaluator does; return it and its wrapper."""
    theirs = importlib.import_module("leaderboard.autoagents.agent_wrapper")
    agent = getattr(module, module.get_entry_point())("localhost", 2000, 0)
    agent.set_global_plan(*plan())
    agent.setup(conf)
    theirs.validate_sensor_configuration(agent.sensors(), agent.track, "SENSORS")
    wrapper = theirs.AgentWrapperFactory.get_wrapper(agent)
    for spec in agent.sensors():
        wrapper._preprocess_sensor_spec(spec)
        agent.sensor_interface.register_sensor(spec["id"], spec["type"], None)
    world.sensors = agent.sensors()
    return agent, wrapper


def observations(
    world: World, network: Network, folder: Path, frames: int
) -> Iterator[dict[str, float]]:
    """Yield, frame by frame, how far our observation is from what VAD's agent made."""
    zoo = importlib.import_module("vad_b2d_agent")
    zoo.VadAgent.save = lambda self, data: None  # pictures
    vad, wrapper = started(zoo, f"config+weights+{SAVE_NAME}", world)
    ours = graph_agent.GraphAgent("localhost", 2000)
    ours.set_global_plan(*plan())
    ours.setup(str(graph(folder)))
    nodes, follow = list[Any](), vad.pidcontroller.control_pid

    def followed(waypoints: Any, speed: Any, node: Any) -> Any:
        nodes.append(node)
        return follow(waypoints, speed, node)

    vad.pidcontroller.control_pid = followed
    control, before = None, None
    for _ in range(frames):
        world.tick(control)
        sensed = world.sensed()
        for name, (frame, data) in sensed.items():
            vad.sensor_interface.update_sensor(name, data, frame)
        control = wrapper()
        reading = ours.tick(sensed)
        seen = ours._observer.observe(sensed, reading, 0)
        yield differences(network.given[-1], before, seen, (nodes[-1], reading.node))
        before = network.given[-1]["can_bus"]


def differences(
    made: dict[str, Any], before: Any, seen: Any, nodes: tuple[Any, Any]
) -> dict[str, float]:
    bus, ours = made["can_bus"], seen.can_bus.astype(float)
    last = bus if before is None else before
    turned = math.remainder(bus[17] - last[17], 360.0)
    return {
        "images": _far(np.stack(made["img"]).astype(float), seen.images),
        "lidar2img": _far(made["lidar2img"], LIDAR.projection(seen.lidar2img)),
        "moved": _far(bus[:2] - last[:2], ours[:2]),
        "rotation": _far(bus[3:7], ours[3:7]),
        "motion": _far(bus[7:16], ours[7:16]),
        "heading": abs(math.remainder(bus[16] - ours[16], 2 * math.pi)),
        "turned": abs(turned - ours[17]),
        "command": _far(made["command"], seen.command),
        "node": _far(*nodes),
    }


def controls(drives: int) -> dict[str, float]:
    """Return how far our controls are from their PID controller's, on drawn plans."""
    theirs = importlib.import_module("pid_controller")
    random, worst = np.random.default_rng(0), np.zeros(3)
    for _ in range(drives):
        pid, ours = theirs.PIDController(), WaypointPid(PidOptions())
        for _ in range(20):
            speed, wanted = np.abs(random.normal(5.0, 4.0, 2))
            angles = random.normal(0.0, 0.1) * wanted * np.arange(6)
            steps = np.stack([np.cos(angles), np.sin(angles)], 1) * wanted / 2
            ahead = np.cumsum(steps + random.normal(0.0, 0.1, (6, 2)), axis=0)
            right = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
            node = random.normal((0.0, 10.0), 15.0)
            steer, throttle, brake, _ = pid.control_pid(right, speed, node)
            found = ours.control(ahead, float(speed), (node[0], node[1]))
            off = np.array([throttle, steer, float(brake)]) - found
            worst = np.maximum(worst, np.abs(off))
    return dict(zip(("throttle", "steer", "brake"), worst.tolist(), strict=True))


def wrapped(world: World, folder: Path, frames: int) -> int:
    """Count the frames in which the wrapped VAD agent acts otherwise than the rule."""
    conf = folder / "wrap.toml"
    conf.write_text(
        f'agent = "vad_b2d_agent"\nconfig = "config+weights"\nlatency = "fps:{FPS}"\n'
    )
    agent, wrapper = started(real_time, f"{conf}+again_{SAVE_NAME}", world)
    inner, made = agent._inner, dict[int, Any]()
    numbers, held, wrong = count(1), HeldControl(0), 0
    decide = inner.run_step

    def decided(data: Any, timestamp: float) -> Any:
        made[len(made) + 1] = decide(data, timestamp)
        return made[len(made)]

    inner.run_step = decided
    control = None
    for _ in range(frames):
        world.tick(control)
        for name, (frame, data) in world.sensed().items():
            agent.sensor_interface.update_sensor(name, data, frame)
        control = wrapper()
        if held.decision_is_due:
            held.decide(next(numbers), round(1e6 / FPS))
        acting = made.get(held.advance())
        expected = (0.0, 0.0, 1.0)
        if acting is not None:
            expected = (acting.throttle, acting.steer, acting.brake)
        wrong += (control.throttle, control.steer, control.brake) != expected
        control.steer += 0.01  # ControlLoss
    agent.destroy()
    return wrong


def graph(folder: Path) -> Path:
    """Write a graph that sees six whole pictures, and the options of its agent."""
    model = onnx.parser.parse_model(GRAPH)
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.array([2]), "last"))
    text = '{"mean": [0, 0, 0], "std": [1, 1, 1], "order": "rgb"}'
    model.metadata_props.add(key="me2e.image", value=text)
    onnx.save(model, folder / "driver.onnx")
    options = folder / "graph.toml"
    options.write_text(
        f'model = "{folder / "driver.onnx"}"\norigin_m = [-0.39, 0.0, 1.84]\n'
    )
    return options


def _far(theirs: Any, ours: Any) -> float:
    return float(np.abs(np.asarray(theirs, float) - np.asarray(ours, float)).max())


if __name__ == "__main__":
    main()
