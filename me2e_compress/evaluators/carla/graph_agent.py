"""An ONNX graph that keeps the policy contract, as an agent of the leaderboard."""

from pathlib import Path

from pydantic import Field

from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.answer import checked
from me2e_compress.driving.contract import PedalsAndWheel
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.driving.waypoint_pid import PidOptions, WaypointPid
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.carla.agent_logs import MetricInfo
from me2e_compress.evaluators.carla.agent_options import (
    AgentOptions,
    conf_parts,
    route_folder,
)
from me2e_compress.evaluators.carla.interface import (
    CarlaControl,
    ForwardingAgent,
    SensorData,
    SensorSpecs,
    autonomous_agent_class,
    carla_control,
)
from me2e_compress.evaluators.carla.observer import (
    CarlaObserver,
    CarlaReading,
    RouteReader,
)
from me2e_compress.evaluators.carla.rig import (
    BENCH2DRIVE_CAMERAS,
    CarlaCamera,
    CarlaRig,
    Triple,
)
from me2e_compress.runtime.providers import PROVIDERS


def get_entry_point() -> str:
    """Name the class that the leaderboard makes."""
    return "GraphAgent"


class GraphAgentOptions(AgentOptions):
    """Which graph drives, and its cameras and controller.

    Attributes:
        model: The ONNX file.
        adapter: TOML file that adapts it to the contract, or the name of one that
            ships; None if it keeps the contract.
        provider: Execution provider, as a text.
        folder: Where each route's folder with ``metric_info.json`` is made: the
            leaderboard's SAVE_PATH; None writes none.
        width: Columns of CARLA's pictures.
        height: Rows of CARLA's pictures.
        cameras: Six, in the contract's order.
        origin_m: Origin of the model's ground frame, in the ego frame (x forward, y
            left, z up). The Zoo's models have it at their lidar: -0.39, 0.0, 1.84.
        jpeg_quality: See `CarlaObserver`.
        pid: Gains and limits of the controller.
    """

    model: Path
    adapter: Path | None = None
    provider: str = "cpu"
    folder: Path | None = None
    width: int = Field(default=1600, ge=16, le=4096)
    height: int = Field(default=900, ge=16, le=4096)
    cameras: tuple[CarlaCamera, ...] = Field(
        default=BENCH2DRIVE_CAMERAS, min_length=6, max_length=6
    )
    origin_m: Triple = (0.0, 0.0, 0.0)
    jpeg_quality: int = Field(default=20, ge=0, le=100)
    pid: PidOptions = PidOptions()

    def policy(self) -> OnnxPolicy:
        """Open the graph, with its recurrent state at its first value."""
        if not self.model.is_file():
            raise EvaluationError(f"model {self.model}: no such file")
        named = self.adapter
        adapter = None if named is None else Adapter.load(adapter_file(named))
        policy = OnnxPolicy.open(self.model, adapter, PROVIDERS.parse(self.provider))
        policy.reset(None)
        return policy

    def observer(self, policy: OnnxPolicy) -> CarlaObserver:
        """Build the observer for this policy.

        Padding has the mean colour, so it becomes zero, as in the pipelines of VAD and
        UniAD.
        """
        rig = CarlaRig(self.cameras, (self.width, self.height), policy.image_size)
        fill: tuple[int, ...] = (0, 0, 0)
        if (found := policy.normalization) is not None:
            mean = found.mean if found.order == "rgb" else found.mean[::-1]
            levels = (round(level / found.scale) for level in mean)
            fill = tuple(min(max(level, 0), 255) for level in levels)
        seen = policy.inputs.cameras
        return CarlaObserver(rig, seen, self.origin_m, self.jpeg_quality, fill)


class GraphAgent(ForwardingAgent):
    """Drives a graph: sensors, observation, plan, control; or its controls as they are.

    Its cheap method is ``tick``, as in Bench2DriveZoo's agents; `RealTimeAgent` adds
    the latency to the drive.
    """

    def setup(self, path_to_conf_file: str) -> None:
        """Open the graph that ``FILE.toml+...+save_name`` or ``FILE.onnx+...`` names.

        The TOML file holds `GraphAgentOptions`; a graph alone takes their defaults.

        Raises:
            EvaluationError: Unusable options or graph, or no leaderboard on the path.
        """
        path, save_name = conf_parts(path_to_conf_file)
        if path.suffix == ".onnx":
            options = GraphAgentOptions(model=path)
        else:
            options = GraphAgentOptions.load(path)
        # the graph, its observer and its controller
        base = autonomous_agent_class()
        self._policy = options.policy()
        observer = options.observer(self._policy)
        self._specs = observer.rig.specs(observer.seen)
        self._observer = observer
        self._pid = WaypointPid(options.pid)
        self._reader: RouteReader | None = None
        self._began_s: float | None = None
        # what Bench2Drive's evaluator reads of an agent
        self.step, self.metric_info = -1, dict[int, object]()
        self.save_path: Path | None = None
        if options.folder is not None:
            self.save_path = route_folder(options.folder, save_name)
        self._metrics = MetricInfo(self, Path())
        self.adopt(base)

    def sensors(self) -> SensorSpecs:
        """List the cameras that the graph takes, IMU, GPS and speedometer."""
        return self._specs

    def tick(self, input_data: SensorData) -> CarlaReading:
        """Count the step and follow the route, as every frame must."""
        self.step += 1
        if self._reader is None:
            self._reader = RouteReader(
                self._inner._global_plan, self._inner._global_plan_world_coord
            )
        return self._reader.read(input_data)

    def run_step(self, input_data: SensorData, timestamp: float) -> CarlaControl:
        """Return this frame's control."""
        reading = self.tick(input_data)
        # times count from the first tick
        if self._began_s is None:
            self._began_s = timestamp
        time_us = round((timestamp - self._began_s) * 1e6)
        observation = self._observer.observe(input_data, reading, time_us)
        try:
            found = checked(self._policy.plan(observation))
        except EvaluationError as error:
            raise EvaluationError(f"step {self.step}: {error}") from error
        # a plan is followed by PID
        if not isinstance(found, PedalsAndWheel):
            speed_mps = reading.motion.speed_mps
            found = self._pid.control(found, speed_mps, reading.node)
        self._metrics.note(self.step)
        return carla_control(found.throttle, found.steer, found.brake)

    def destroy(self) -> None:
        """Write ``metric_info.json`` if there is a folder for it."""
        if self._inner is not None:
            if self.save_path is not None:
                self._metrics.write()
            self._inner.destroy()
