"""An ONNX graph that keeps the policy contract, as an agent of the leaderboard."""

from pathlib import Path

from pydantic import Field

from me2e_compress.agents.agent_options import AgentOptions, conf_parts, route_folder
from me2e_compress.agents.carla_interface import (
    CarlaControl,
    SensorData,
    SensorSpecs,
    autonomous_agent_class,
    carla_control,
)
from me2e_compress.agents.carla_observer import (
    CarlaObserver,
    CarlaReading,
    Preprocessing,
    RouteReader,
)
from me2e_compress.agents.carla_rig import (
    BENCH2DRIVE_CAMERAS,
    CarlaCamera,
    CarlaRig,
    Triple,
)
from me2e_compress.agents.forwarding import ForwardingAgent
from me2e_compress.agents.metric_info import MetricInfo
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.answer import checked
from me2e_compress.driving.contract import PedalsAndWheel
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.driving.waypoint_pid import PidOptions, WaypointPid
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.providers import PROVIDERS


def get_entry_point() -> str:
    """Name the class that the leaderboard makes."""
    return "GraphAgent"


class GraphAgentOptions(AgentOptions):
    """Which graph drives, and how it sees.

    Attributes:
        model: The ONNX file.
        adapter: TOML file that adapts it to the contract, or the name of one that
            ships; None where it keeps it.
        provider: What runs it, as a text.
        folder: Where each route's folder with ``metric_info.json`` is made: what the
            leaderboard is given as SAVE_PATH; None writes none.
        width: Columns of CARLA's pictures.
        height: Rows of CARLA's pictures.
        cameras: Six, in the contract's order.
        origin_m: Where the model's ground frame has its origin, in the ego frame (x
            forward, y left, z up). The Zoo's models have it at their lidar:
            -0.39, 0.0, 1.84.
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
        """Open the graph, its recurrent state at its first value.

        Raises:
            EvaluationError: No such file, or it cannot drive.
            ProviderError: The provider is not there.
        """
        if not self.model.is_file():
            raise EvaluationError(f"model {self.model}: no such file")
        named = self.adapter
        adapter = None if named is None else Adapter.load(adapter_file(named))
        policy = OnnxPolicy.open(self.model, adapter, PROVIDERS.parse(self.provider))
        policy.reset(None)
        return policy

    def observer(self, policy: OnnxPolicy) -> CarlaObserver:
        """Build what makes the observations that this policy takes.

        What is padded has the mean colour, which becomes zero, as the pipelines of VAD
        and UniAD pad after normalisation.
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

    Its cheap part is ``tick``, as in Bench2DriveZoo's agents; `RealTimeAgent` puts its
    latency into the drive.
    """

    def setup(self, path_to_conf_file: str) -> None:
        """Open the graph.

        Args:
            path_to_conf_file: ``FILE.toml+...+save_name``, see `GraphAgentOptions`; or
                the graph itself, ``FILE.onnx+...``, at the defaults.

        Raises:
            EvaluationError: The options or the graph are unusable, or the leaderboard
                is not on the path.
            MissingPackageError: CARLA's client is not installed.
            ProviderError: The provider is not there.
        """
        path, save_name = conf_parts(path_to_conf_file)
        if path.suffix == ".onnx":
            options = GraphAgentOptions(model=path)
        else:
            options = GraphAgentOptions.load(path)
        base = autonomous_agent_class()
        self._policy = options.policy()
        observer = options.observer(self._policy)
        self._specs = observer.rig.specs(observer.seen)
        self._observer: Preprocessing = observer
        self._pid = WaypointPid(options.pid)
        self._reader: RouteReader | None = None
        self._began_s: float | None = None
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
        """Count the step and follow the route; every frame needs it, decided or not."""
        self.step += 1
        if self._reader is None:
            self._reader = RouteReader(
                self._inner._global_plan, self._inner._global_plan_world_coord
            )
        return self._reader.read(input_data)

    def run_step(self, input_data: SensorData, timestamp: float) -> CarlaControl:
        """Return the control that follows from this frame.

        Raises:
            EvaluationError: The plan is not finite, or a control out of its range.
            GraphError: A node of the model failed.
        """
        reading = self.tick(input_data)
        if self._began_s is None:
            self._began_s = timestamp
        time_us = round((timestamp - self._began_s) * 1e6)
        observation = self._observer.observe(input_data, reading, time_us)
        try:
            found = checked(self._policy.plan(observation))
        except EvaluationError as error:
            raise EvaluationError(f"step {self.step}: {error}") from error
        if not isinstance(found, PedalsAndWheel):
            speed_mps = reading.motion.speed_mps
            found = self._pid.control(found, speed_mps, reading.node)
        self._metrics.note(self.step)
        return carla_control(found.throttle, found.steer, found.brake)

    def destroy(self) -> None:
        """Write ``metric_info.json`` where there is a folder for it."""
        if self._inner is not None:
            if self.save_path is not None:
                self._metrics.write()
            self._inner.destroy()
