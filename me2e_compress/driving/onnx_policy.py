"""A policy that runs an ONNX file, in whichever world it drives."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from me2e_compress.driving.adapter import Adapter, ImageNormalization
from me2e_compress.driving.adapter.inputs import ModelInputs, contract_names
from me2e_compress.driving.adapter.outputs import ModelOutputs
from me2e_compress.driving.adapter.recurrent import FirstValues, answers_by_input
from me2e_compress.driving.answer import PLAN_TIMES_S, six_waypoints
from me2e_compress.driving.contract import Answer, Observation, RouteInfo, Trajectory
from me2e_compress.driving.host_stage import HostStage
from me2e_compress.driving.ports import fits
from me2e_compress.errors import EvaluationError, FramesError, GraphError
from me2e_compress.runtime.any_session import AnySession
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.stack.stack_session import open_session


@dataclass
class OnnxPolicy:
    """Runs an ONNX graph or a stack of several, on one thread that does not spin.

    Inputs ``img`` float [1, 6, 3, H, W], ``lidar2img`` [1, 6, 4, 4], ``can_bus`` [18],
    ``command`` int64 [1] and ``timestamp`` float [1], seconds since the route began, of
    which a model may lack any; recurrent inputs ``X`` answered by ``X_out``, zeros at
    the start of a route; output ``plan`` [1, 6, 2]. An `Adapter` maps other names and
    layouts, first values, waypoints of any number and spacing, and controls.

    Attributes:
        session: The loaded graph.
        adapter: How its ports relate to the contract.
        inputs: How it is fed.
        outputs: How its answer is read.
        recurrent: Recurrent input to the output that answers it.
        first: What these hold where a route begins.
        stage: Changes the plan on the host; None leaves it as the network has it.
        host_iterations: Of that stage, for the latest plan.
        host_cells: That the stage took into account, for the latest plan.
    """

    session: AnySession
    adapter: Adapter
    inputs: ModelInputs
    outputs: ModelOutputs
    recurrent: dict[str, str]
    first: FirstValues
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
    ) -> Self:
        """Load a model and run it once on zeros.

        Args:
            path: The file, or the TOML of a stack of several.
            adapter: How its ports relate to the contract; None where they keep it.
            provider: What runs it.
            stage: Changes the plan on the host; None leaves it.

        Raises:
            EvaluationError: It cannot be run, or does not keep the contract.
            ProviderError: The provider is not there.
        """
        try:
            session = open_session(path, threads=1, provider=provider)
            return cls.of(session, adapter or Adapter(), stage)
        except (GraphError, FramesError, EvaluationError) as error:
            words = str(error).removeprefix(f"{path}: ")
            raise EvaluationError(f"{path}: {words}") from error

    @classmethod
    def of(
        cls, session: AnySession, adapter: Adapter, stage: HostStage | None = None
    ) -> Self:
        """Drive a graph that is open, and run it once on zeros; see :meth:`open`.

        Raises:
            EvaluationError: It does not keep the contract.
            FramesError: It cannot be fed.
            GraphError: A node of the model failed.
        """
        recurrent = recurrent_of(session, adapter)
        inputs = ModelInputs.of(session, adapter, recurrent)
        outputs = ModelOutputs.of(session, adapter)
        if stage is not None and outputs.plan is None:
            raise EvaluationError(
                f"{stage.name} changes a plan, and this model answers controls alone"
            )
        first = FirstValues.of(session, adapter.recurrent, recurrent)
        policy = cls(session, adapter, inputs, outputs, recurrent, first, stage)
        policy._dry_run()
        return policy

    @property
    def needs_images(self) -> bool:
        """Whether the model has an image input."""
        return bool(self.inputs.images)

    @property
    def normalization(self) -> ImageNormalization | None:
        """How the images are normalised; None where they are not."""
        return self.inputs.normalization

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns in which the cameras are rendered."""
        return self.inputs.image_size

    def reset(self, route: RouteInfo | None) -> None:
        """Begin a route: recurrent inputs hold their first values again."""
        self._begins = True
        known = self.session.first_state(self.first.held)
        self.inputs.reset()
        self.outputs.reset()
        own = {name: each for name, each in known.items() if name in self.recurrent}
        self._state = {**self.first.zeros, **own}

    def plan(self, observation: Observation) -> Answer:
        """Run the model once.

        Raises:
            EvaluationError: It needs images and there are none, or the host stage lacks
                an output.
            GraphError: A node of the model failed.
        """
        feeds = self.feeds(observation)
        if self._begins:
            self._state |= self.first.at(feeds)
        outputs = self.session.run({**self._state, **feeds}, first=self._begins)
        self._begins = False
        self._state = {name: outputs[to] for name, to in self.recurrent.items()}
        plan = self.outputs.trajectory(outputs, feeds, observation)
        if plan is not None and self.stage is not None:
            plan = self._changed(plan, self.stage, outputs)
        return self.outputs.answer(plan, outputs, observation)

    def _changed(
        self, plan: Trajectory, stage: HostStage, outputs: dict[str, Array]
    ) -> Trajectory:
        """Let the host change the plan, as six waypoints every 0.5 s."""
        work = stage.work(six_waypoints(plan), outputs)
        self.host_iterations, self.host_cells = work.iterations, work.cells
        return Trajectory(work.plan, PLAN_TIMES_S)

    def feeds(self, observation: Observation) -> dict[str, Array]:
        """Lay an observation out as the graph takes it, recurrent inputs left out.

        Raises:
            EvaluationError: It needs images and there are none.
        """
        return self.inputs.feeds(observation)

    def _dry_run(self) -> None:
        """Run once on zeros: what does not fit here would fail on every route."""
        self.reset(None)
        self.plan(self.inputs.nothing(command=0))
        for name, answer in self.recurrent.items():
            given, wanted = self._state[name].shape, self.session.inputs[name].shape
            if not fits(given, wanted):
                raise EvaluationError(
                    f"output {answer} has shape {list(given)}, the recurrent input "
                    f"{name} takes {list(wanted)}"
                )


def recurrent_of(session: AnySession, adapter: Adapter) -> dict[str, str]:
    """Return each recurrent input with the output that answers it."""
    fed_otherwise = {*adapter.feeds, *adapter.images}
    if adapter.recurrent is not None:
        fed_otherwise |= set(contract_names(adapter).values())
    return answers_by_input(session, adapter.recurrent, fed_otherwise)
