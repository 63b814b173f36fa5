"""Equation 4 in a real leaderboard run: a wrapper around any agent.

The leaderboard is left as it is. It waits for ``run_step`` while the world stands
still, however long that takes. This agent derives from the measured time, or from a
latency source, in which frame the control acts, exactly as the evaluator of highway-env
does (`me2e_compress.driving.realtime`).
"""

import hashlib
import re
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from me2e_compress.driving.latency import (
    Charge,
    DecisionFacts,
    LatencySource,
    parse_latency,
)
from me2e_compress.driving.realtime import (
    DT_US,
    ControlClock,
    LatencyModel,
    control_clock,
)
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.carla.agent_logs import DecisionLog, MetricInfo
from me2e_compress.evaluators.carla.agent_options import (
    AgentOptions,
    agent_class,
    agent_module,
    conf_parts,
    function_named,
    route_folder,
)
from me2e_compress.evaluators.carla.interface import (
    CarlaControl,
    ForwardingAgent,
    SensorData,
    SensorSpecs,
    agents_around,
    carla_control,
    copy_of,
)
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.profile import processor

WALL_CLOCK = re.compile(r"(_\d\d){5}$")
"""The end of a save name: month, day, hour, minute, second of the start."""

RATE_SLACK_S = 1e-3
"""Simulated time is a sum of floating-point steps."""


def get_entry_point() -> str:
    """Name the class that the leaderboard makes."""
    return "RealTimeAgent"


class RealTimeOptions(AgentOptions):
    """How an agent is wrapped.

    Attributes:
        agent: The wrapped agent's file, or a module such as
            ``me2e_compress.evaluators.carla.graph_agent``.
        config: Its own configuration text, without the save name.
        latency: What a decision costs: ``measured`` here, ``fps:F``, ``trace:FILE``.
        latency_model: ``drop`` is equation 4.
        in_order: See `TraceLatency`.
        scale: See `TraceLatency` and `MeasuredLatency`.
        seed: See `TraceLatency`.
        tick: The wrapped agent's cheap method, called with the sensors' data in frames
            that skip its decision: it follows the route and counts steps. The agents of
            Bench2DriveZoo call it ``tick``; empty if there is none.
        synchronize: ``module:function`` that waits until the GPU is done, such as
            ``torch.cuda:synchronize``; empty if ``run_step`` returns with its result
            computed.
        folder: Where each route's folder is made; None takes the agent's own
            ``save_path``.
        model: The file whose digest the trace carries; None takes the agent's file.
        machine: Description of the machine; empty for this machine's processor.
    """

    agent: str
    config: str = ""
    latency: str = "measured"
    latency_model: LatencyModel = LatencyModel.DROP
    in_order: bool = False
    scale: float = 1.0
    seed: int = 0
    tick: str = "tick"
    synchronize: str = ""
    folder: Path | None = None
    model: Path | None = None
    machine: str = ""

    def source(self) -> LatencySource:
        """Build the latency source."""
        return parse_latency(
            self.latency, in_order=self.in_order, scale=self.scale, seed=self.seed
        )


class RealTimeAgent(ForwardingAgent):
    """Delays every control of the wrapped agent by its latency.

    In a frame whose decision is skipped only the wrapped agent's cheap method is
    called; ``metric_info`` goes on in every frame. The first call warms up: a measured
    latency charges nothing for it, and the trace leaves it out. Before the first
    control acts, the brake is pressed fully. Each frame gets its own copy of the
    control, since the leaderboard's ControlLoss changes it in place.
    """

    now_ns: Callable[[], int] = staticmethod(time.perf_counter_ns)
    _log: DecisionLog | None = None
    _last_s: float | None = None

    def setup(self, path_to_conf_file: str) -> None:
        """Make the wrapped agent from ``FILE.toml+...+save_name`` and set it up.

        The file holds `RealTimeOptions`.

        Raises:
            EvaluationError: The options, the wrapped agent or the folder are unusable.
            MissingPackageError: CARLA's client is not installed.
        """
        path, save_name = conf_parts(path_to_conf_file)
        options = RealTimeOptions.load(path)
        source, brake = options.source(), carla_control(0.0, 0.0, 1.0)
        if options.model is not None and not options.model.is_file():
            raise EvaluationError(f"model {options.model}: no such file")
        self._synchronize = function_named(options.synchronize)
        # the wrapped agent, set up as the leaderboard would
        module = agent_module(options.agent)
        self.adopt(agent_class(module))
        if options.tick and not hasattr(self._inner, options.tick):
            raise EvaluationError(
                f"agent {options.agent} has no method {options.tick}: name its cheap "
                'part as `tick`, or "" where there is none'
            )
        self._inner.setup("+".join(filter(None, (options.config, save_name))))
        # what the route's decisions cost
        self._clock: ControlClock[CarlaControl] = control_clock(
            options.latency_model, brake, DT_US
        )
        self._charge = self._clock_of(source, WALL_CLOCK.sub("", save_name))
        self._tick, self._frame, self._began_ns = options.tick, 0, self.now_ns()
        # where its trace and metrics go
        folder = self._folder(options, save_name)
        self._metrics = MetricInfo(self._inner, folder)
        model = _digest(options.model or Path(str(module.__file__)))
        self._log = DecisionLog(folder, model, options.machine or processor())

    def sensors(self) -> SensorSpecs:
        """List the wrapped agent's sensors."""
        specs: SensorSpecs = self._inner.sensors()
        return specs

    def run_step(self, input_data: SensorData, timestamp: float) -> CarlaControl:
        """Return the control that acts in this frame, as a copy.

        If the wrapped agent raises, the trace and ``metric_info.json`` are still
        written. The world must tick at 20 Hz.
        """
        with ExitStack() as failed:
            failed.callback(self._write)
            self._check_rate(timestamp)
            if self._clock.decision_is_due:
                self._decide(input_data, timestamp)
            else:
                self._skip(input_data)
            self._metrics.note(self._frame)
            failed.pop_all()
        self._frame += 1
        return copy_of(self._clock.advance())

    def destroy(self) -> None:
        """Write the trace and ``metric_info.json``, then destroy the wrapped agent."""
        try:
            self._write()
        finally:
            if self._inner is not None:
                self._inner.destroy()

    def _check_rate(self, timestamp: float) -> None:
        before, self._last_s = self._last_s, timestamp
        if before is not None and abs(timestamp - before - DT_US / 1e6) > RATE_SLACK_S:
            raise EvaluationError(
                f"frame {self._frame}: the world ticked {timestamp - before:.3f} s: "
                f"equation 4 is charged at {DT_US / 1e6:g} s"
            )

    def _decide(self, input_data: SensorData, timestamp: float) -> None:
        self._synchronize()
        begun = self.now_ns()
        control = self._inner.run_step(input_data, timestamp)
        self._synchronize()
        done = self.now_ns()
        measured_us = (done - begun) // 1_000
        latency_us = self._charge(self._facts(measured_us))
        self._clock.decide(copy_of(control), latency_us)
        wall_s = round((done - self._began_ns) / 1e9, 6)
        if self._log is not None:
            self._log.note(
                frame=self._frame,
                time_s=timestamp,
                wall_s=wall_s,
                measured_us=measured_us,
                latency_us=latency_us,
            )

    def _facts(self, measured_us: int) -> DecisionFacts:
        around = agents_around(getattr(self._inner, "hero_actor", None))
        return DecisionFacts(measured_us, around)

    def _clock_of(self, source: LatencySource, route: str) -> Charge:
        """Return the route's clock; a first decision that is measured here is free."""
        source.on_route(route)(self._facts(0))  # a clock of its own
        charge, warm = source.on_route(route), not source.measures

        def charged(facts: DecisionFacts) -> int:
            nonlocal warm
            latency_us, warm = (charge(facts) if warm else 0), True
            return latency_us

        return charged

    def _skip(self, input_data: SensorData) -> None:
        """Show the frame to the wrapped agent, and count it, without deciding."""
        before = getattr(self._inner, "step", None)
        if self._tick:
            getattr(self._inner, self._tick)(input_data)
        if before is not None and self._inner.step == before:
            self._inner.step += 1

    def _write(self) -> None:
        if self._log is not None:
            self._log.write_trace()
            self._metrics.write()

    def _folder(self, options: RealTimeOptions, save_name: str) -> Path:
        own = getattr(self._inner, "save_path", None)
        if options.folder is not None:
            return route_folder(options.folder, save_name)
        if own is None:
            raise EvaluationError(
                f"agent {options.agent} has no save_path: name a `folder`"
            )
        return Path(own)


def _digest(path: Path) -> str:
    """Hash a file; a graph together with its weights, as `profile` does."""
    if path.suffix == ".onnx":
        return sha256_of(path)
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
