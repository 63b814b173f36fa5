"""A policy that runs an ONNX file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from me2e_compress.base.errors import EvaluationError, FramesError, GraphError
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.adapter.adapter import ZEROS, ModelInputs, contract_names
from me2e_compress.driving.adapter.outputs import COMMAND, find_plan
from me2e_compress.driving.contract import (
    PLAN_TIMES_S,
    Observation,
    RouteInfo,
    Trajectory,
    fits,
    six_waypoints,
)
from me2e_compress.driving.host_stage import HostStage
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.plan_adapter import Arrays, PlanAdapter
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, zero_state


def first_sources(
    session: Session, adapter: Adapter, recurrent: Mapping[str, str]
) -> dict[str, str]:
    """Map recurrent inputs to the inputs whose value they take where a route begins.

    All others begin with zeros.

    Raises:
        EvaluationError: An input does not exist, is recurrent itself, or does not fit.
    """
    values, ports = dict[str, str](), session.inputs
    for name, entry in (adapter.recurrent or {}).items():
        if (source := entry.first) == ZEROS:
            continue
        where = f"first value of {name}: {source}"
        if source not in ports or source in recurrent:
            others = ", ".join(port for port in ports if port not in recurrent)
            raise EvaluationError(
                f"{where} is neither {ZEROS} nor an input that is not recurrent;"
                f" those are {others or 'none'}"
            )
        port, other = ports[name], ports[source]
        if other.type != port.type or not fits(other.shape, port.shape):
            raise EvaluationError(
                f"{where} is {other.type} {list(other.shape)}, the input takes"
                f" {port.type} {list(port.shape)}"
            )
        values[name] = source
    return values


@dataclass
class OnnxPolicy:
    """Runs an ONNX graph, on one thread that does not spin.

    Inputs are ``img`` float [1, 6, 3, H, W], ``lidar2img`` [1, 6, 4, 4], ``can_bus``
    [18], ``command`` int64 [1] and ``timestamp`` float [1], seconds since the route
    began; a model may lack any of them. A recurrent input ``X`` is answered by the
    output ``X_out`` and zero at the start of a route. The output is ``plan`` [1, 6, 2].
    An `Adapter` maps other names and layouts, first values, and waypoints of any number
    and spacing. ``stage`` changes the plan on the host.
    """

    session: Session
    adapter: Adapter
    inputs: ModelInputs
    reads: PlanAdapter
    recurrent: dict[str, str]  # input to the output that answers it
    first: Mapping[str, str]  # recurrent input to the input whose value it begins with
    stage: HostStage | None = None
    host_iterations: int = field(default=0, init=False)
    host_cells: int = field(default=0, init=False)
    privileged: bool = field(default=False, init=False)
    _state: dict[str, Array] = field(default_factory=dict, init=False)
    _begins: bool = field(default=True, init=False)

    @classmethod
    def open(
        cls,
        path: Path,
        adapter: Adapter | None = None,
        provider: Provider = CPU,
        stage: HostStage | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> Self:
        """Load a file, and run it once on zeros.

        ``metadata`` are metadata that override the model's own.

        Raises:
            EvaluationError: It cannot be run, or does not keep the contract.
        """
        try:
            session = Session(
                path, threads=1, int8_kernels=True, provider=provider, metadata=metadata
            )
            return cls.of(session, adapter or Adapter(), stage)
        except (GraphError, FramesError, EvaluationError) as error:
            words = str(error).removeprefix(f"{path}: ")
            raise EvaluationError(f"{path}: {words}") from error

    @classmethod
    def of(
        cls, session: Session, adapter: Adapter, stage: HostStage | None = None
    ) -> Self:
        """Drive a graph that is open, and run it once on zeros; see :meth:`open`."""
        recurrent = recurrent_of(session, adapter)
        inputs = ModelInputs.of(session, adapter, recurrent)
        reads = find_plan(session, adapter)
        first = first_sources(session, adapter, recurrent)
        policy = cls(session, adapter, inputs, reads, recurrent, first, stage)
        # Find a misfit that only a run shows: of types, of shapes, of recurrent outputs
        policy.reset(None)
        policy.plan(inputs.blank_observation())
        for name, answer in recurrent.items():
            shape, wanted = policy._state[name].shape, session.inputs[name].shape
            if not fits(shape, wanted):
                raise EvaluationError(
                    f"output {answer} has shape {list(shape)}, the recurrent input "
                    f"{name} takes {list(wanted)}"
                )
        return policy

    @property
    def needs_images(self) -> bool:
        """Whether the model has an image input."""
        return bool(self.inputs.images)

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns in which the cameras are rendered."""
        return self.inputs.image_size

    def reset(self, route: RouteInfo | None) -> None:
        """Begin a route: recurrent inputs return to their first values."""
        self._begins = True
        self.inputs.reset()
        ports, begin = self.session.inputs, self.recurrent.keys() - self.first.keys()
        self._state = {name: zero_state(name, ports[name]) for name in sorted(begin)}

    def first_values(self, feeds: Arrays) -> dict[str, Array]:
        """Return the recurrent inputs that begin with an input's value, and that."""
        return {name: feeds[source] for name, source in self.first.items()}

    def plan(self, observation: Observation) -> Trajectory:
        """Run the model once."""
        # Run the model, with first values where a route begins
        feeds = self.inputs.feeds(observation)
        if self._begins:
            self._state |= self.first_values(feeds)
        outputs = self.session.run({**self._state, **feeds})
        self._begins = False
        self._state = {name: outputs[to] for name, to in self.recurrent.items()}
        plan = self.trajectory(outputs, feeds, observation)
        # The host stage changes six waypoints every 0.5 s
        if self.stage is not None:
            work = self.stage.work(six_waypoints(plan), outputs)
            self.host_iterations, self.host_cells = work.iterations, work.cells
            plan = Trajectory(work.plan, PLAN_TIMES_S)
        return plan

    def trajectory(
        self, outputs: Arrays, feeds: Arrays, observation: Observation
    ) -> Trajectory:
        """Return the plan of the network's outputs, in the ego frame."""
        command = np.array([observation.command])
        points = self.reads.plan(outputs, {**feeds, COMMAND: command})
        return self.reads.trajectory(self.adapter.to_ego(points))


def recurrent_of(session: Session, adapter: Adapter) -> dict[str, str]:
    """Map recurrent inputs to the outputs that answer them, by adapter and metadata."""
    # The adapter feeds some inputs in another way: metadata do not make them recurrent
    other_inputs, entries = {*adapter.feeds, *adapter.images}, adapter.recurrent
    if entries is not None:
        other_inputs |= set(contract_names(adapter).values())
    own = {k: v for k, v in session.recurrent.items() if k not in other_inputs}
    for name, entry in (entries or {}).items():
        answer = entry.answer or own.get(name)
        if answer is None:
            raise EvaluationError(
                f"recurrent input {name}: no output answers it by its name; say from ="
                f" one of {', '.join(session.outputs)}"
            )
        own[name] = answer
    return own
