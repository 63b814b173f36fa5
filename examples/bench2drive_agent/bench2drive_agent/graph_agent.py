"""An ONNX graph that keeps the policy contract, as an agent of the leaderboard."""

import json
import logging
import math
import re
import time
import tomllib
from pathlib import Path
from typing import Any, Self

import carla  # type: ignore[import-not-found]
import numpy as np
from leaderboard.autoagents.autonomous_agent import (  # type: ignore[import-not-found]
    AutonomousAgent,
    Track,
)
from pydantic import BaseModel, ConfigDict

from bench2drive_agent import sensors as mounted
from bench2drive_agent.route_follower import GeoReference, RouteFollower
from bench2drive_agent.sensors import Images, Pictures, Triple
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.contract import (
    EgoKinematics,
    Observation,
    PedalsAndWheel,
)
from me2e_compress.driving.input_sources import can_bus_between
from me2e_compress.driving.latency import DecisionFacts, parse_latency
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.driving.realtime import DT_US, ControlClock
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.runtime.providers import PROVIDERS
from models.tcp.waypoint_pid import PidOptions, WaypointPid

FULL_BRAKE = PedalsAndWheel(0.0, 0.0, 1.0)
"""Before the first control acts."""
_LOG = logging.getLogger(__name__)
WALL_CLOCK = re.compile(r"(_\d\d){5}$")
"""The end of a save name: month, day, hour, minute, second of the start."""


def get_entry_point() -> str:
    """Name the class that the leaderboard makes."""
    return "GraphAgent"


class AgentOptions(BaseModel):
    """The contents of a TOML file; relative paths start where the leaderboard runs.

    Attributes:
        model: the ONNX file.
        adapter: TOML file that adapts it to the contract, or the name of one that
            ships; None if it keeps the contract.
        provider: execution provider, as a text.
        latency: what a decision costs: ``measured`` here, ``fps:F``, ``trace:FILE``.
        folder: where each route's folder is made: the leaderboard's SAVE_PATH.
        origin_m: origin of the model's ground frame, in the ego frame (x forward, y
            left, z up). The Zoo's models have it at their lidar: -0.39, 0.0, 1.84.
        jpeg_quality: see `Pictures`.
        pid: gains and limits of the controllers that follow a plan.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: Path
    adapter: Path | None = None
    provider: str = "cpu"
    latency: str = "measured"
    folder: Path
    origin_m: Triple = (0.0, 0.0, 0.0)
    jpeg_quality: int = 20
    pid: PidOptions = PidOptions()

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file."""
        return cls.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))

    def policy(self) -> OnnxPolicy:
        """Open the graph, with its recurrent state at its first value."""
        adapter = None
        if self.adapter is not None:
            adapter = Adapter.load(adapter_file(self.adapter))
        policy = OnnxPolicy.open(self.model, adapter, PROVIDERS.parse(self.provider))
        policy.reset(None)
        return policy


class GraphAgent(AutonomousAgent):  # type: ignore[misc]
    """Drives a graph: sensors, observation, plan, control; equation 4 delays it."""

    def setup(self, path_to_conf_file: str) -> None:
        """Open the graph that the file of ``FILE.toml+...+save_name`` names."""
        file, *_, save_name = path_to_conf_file.split("+")
        options = AgentOptions.load(Path(file))
        self.track, self.step = Track.SENSORS, -1
        self.save_path = options.folder / save_name
        self.save_path.mkdir(parents=True)
        self.metric_info = dict[int, Any]()
        self._policy = options.policy()
        self._pid = WaypointPid(options.pid)
        self._last: EgoKinematics | None = None
        nodes = [(*_place(at), option) for at, option in self._global_plan_world_coord]
        first, _ = self._global_plan[0]
        self._follower, self._begins = RouteFollower(nodes), nodes[0][:2]
        self._geo = GeoReference.through(first["lat"], first["lon"], *self._begins)
        self._pictures = Pictures(
            self._policy.image_size, options.jpeg_quality, _fill(self._policy)
        )
        self._lidar2img = self._pictures.lidar2img(options.origin_m)
        # what the route's decisions cost; the first one measured warms up
        latency = parse_latency(options.latency)
        self._is_warm = not latency.measures
        self._charge = latency.on_route(WALL_CLOCK.sub("", save_name))
        self._clock = ControlClock(FULL_BRAKE)

    def sensors(self) -> list[dict[str, Any]]:
        """List the cameras that the graph takes, IMU, GPS and speedometer."""
        return mounted.specs(self._policy.inputs.cameras)

    def run_step(self, input_data: Any, timestamp: float) -> Any:
        """Return the control that acts in this frame, at 20 Hz."""
        self.step += 1
        motion = self._motion(input_data)
        route = self._follower.next(motion.x, motion.y)  # followed in every frame
        if self._clock.decision_is_due:
            began_ns = time.perf_counter_ns()
            answer = self._decide(input_data, motion, *route)
            measured_us = (time.perf_counter_ns() - began_ns) // 1000
            latency_us = self._charge(DecisionFacts(measured_us))
            latency_us, self._is_warm = latency_us if self._is_warm else 0, True
            self._clock.decide(answer, latency_us)
            self._note(measured_us, latency_us)
        if hasattr(self, "get_metric_info"):  # of Bench2Drive's leaderboard alone
            self.metric_info[self.step] = self.get_metric_info()
        control = carla.VehicleControl()
        control.throttle, control.steer, control.brake = self._clock.advance()
        return control

    def destroy(self) -> None:
        """Write ``metric_info.json``, of which Bench2Drive makes comfort."""
        if getattr(self, "metric_info", None):
            text = json.dumps({str(k): each for k, each in self.metric_info.items()})
            (self.save_path / "metric_info.json").write_text(text)

    def _motion(self, sensors: Any) -> EgoKinematics:
        """Return what GPS, IMU and speedometer say, in a right-handed world."""
        reading = sensors[mounted.GPS][1][:2]
        if self.step == 0:
            self._geo = self._geo.as_read(reading, *self._begins)
            if self._geo.mirrored:
                _LOG.warning("GPS latitudes are mirrored, as in CARLA 0.9.16")
        x, y = self._geo.metres(*reading)
        imu = [float(value) for value in sensors[mounted.IMU][1]]
        if math.isnan(imu[6]):  # as it is in the first frames
            imu = [0.0] * 7
        heading = math.pi / 2 - imu[6]  # the compass turns clockwise from north
        acceleration = imu[0], -imu[1], imu[2]
        rates = -imu[3], -imu[4], -imu[5]  # all three, as Bench2Drive's agents do
        speed_mps = float(sensors[mounted.SPEED][1]["speed"])
        return EgoKinematics(x, y, heading, speed_mps, acceleration, rates)

    def _decide(
        self, sensors: Any, motion: EgoKinematics, nodes: np.ndarray, command: int
    ) -> PedalsAndWheel:
        away = nodes - (motion.x, motion.y)
        sin, cos = math.sin(motion.heading), math.cos(motion.heading)
        targets = away @ np.array([[cos, -sin], [sin, cos]])
        observation = Observation(
            self.step * DT_US,
            self._images(sensors),
            self._lidar2img,
            can_bus_between(motion, self._last),
            command,
            motion.speed_mps,
            motion=motion,
            target_points=targets.astype(np.float32),
        )
        self._last = motion
        plan = self._policy.plan(observation)
        forward, left = targets[0].tolist()
        return self._pid.control(plan, motion.speed_mps, (-left, forward))

    def _images(self, sensors: Any) -> Images | None:
        seen = self._policy.inputs.cameras
        if not seen:
            return None
        images = np.zeros((len(mounted.CAMERAS), *self._pictures.size, 3), np.uint8)
        for index, name in enumerate(mounted.CAMERAS):
            if index in seen:
                images[index] = self._pictures.image(sensors[name][1])
        return images

    def _note(self, measured_us: int, latency_us: int) -> None:
        """Write a line for ``me2e-compress score`` and EER_AV."""
        decision = {"measured_us": measured_us, "latency_us": latency_us}
        with (self.save_path / "decisions.jsonl").open("a", encoding="utf-8") as lines:
            lines.write(json.dumps({"frame": self.step, **decision}) + "\n")


def _place(at: Any) -> tuple[float, float]:
    return at.location.x, -at.location.y


def _fill(policy: OnnxPolicy) -> tuple[int, ...]:
    """Return the mean colour, R, G, B, so that padding becomes zero."""
    norms = (each.normalization for each in policy.inputs.images.values())
    if (norm := next(norms, None)) is None:
        return (0, 0, 0)
    mean = norm.mean if norm.order == "rgb" else norm.mean[::-1]
    return tuple(min(max(round(level / norm.scale), 0), 255) for level in mean)
