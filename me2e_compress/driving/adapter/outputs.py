"""Convert a graph's outputs to a policy's answer."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.driving.adapter.adapter import Adapter, ControlAdapter, output_named
from me2e_compress.driving.contract import Answer, Observation, Trajectory
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.graph.modules.module_map import Ports
from me2e_compress.graph.recurrence import declared_pairs, recurrence, sides
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.plan_adapter import PLAN, PlanAdapter
from me2e_compress.runtime.session import Session

COMMAND = "command"
"""Name of the navigator's command among the inputs."""


@dataclass(frozen=True)
class ModelOutputs:
    """How a graph's outputs are read at each decision, without recurrent ones.

    ``plan`` is None if the controls drive, ``control`` if the plan drives.
    """

    adapter: Adapter
    plan: PlanAdapter | None
    control: ControlAdapter | None

    @classmethod
    def of(cls, session: Session, adapter: Adapter) -> Self:
        """Find the outputs of a graph to read."""
        outputs, control = list(session.outputs), adapter.control
        if control is not None:
            check_control(control, outputs)
            return cls(adapter, None, control)
        plan = plan_of(adapter.plan, session.metadata, outputs)
        check_command(plan, session.inputs)
        return cls(adapter, plan, None)

    def trajectory(
        self,
        outputs: Mapping[str, Array],
        feeds: Mapping[str, Array],
        observation: Observation,
    ) -> Trajectory | None:
        """Return the plan in the ego frame; None where controls drive."""
        if self.plan is None:
            return None
        command = np.array([observation.command])
        points = self.plan.plan(outputs, {**feeds, COMMAND: command})
        return self.plan.trajectory(self.adapter.to_ego(points))

    def answer(self, plan: Trajectory | None, outputs: Mapping[str, Array]) -> Answer:
        """Return the plan (as the host stage left it), or the controls."""
        if self.control is not None:
            return self.control.read(outputs)
        assert plan is not None
        return plan


def check_control(control: ControlAdapter, outputs: Sequence[str]) -> None:
    """Check that a graph has the outputs that are read as controls."""
    there = dict.fromkeys(outputs)
    for text, what in control.outputs.items():
        name, _ = output_named(text, there)
        if name not in there:
            raise EvaluationError(
                f"no output {name}, which the adapter names as {what}; there are "
                f"{', '.join(outputs)}"
            )


def check_command(plan: PlanAdapter, inputs: Collection[str]) -> None:
    """Check that the input that picks the plan's mode exists, or is the command."""
    if plan.command_input not in (None, COMMAND, *inputs):
        raise EvaluationError(
            f"no input {plan.command_input}, which picks the plan's mode"
            f" (command_input); there are {COMMAND}, the navigator's, and"
            f" {', '.join(inputs)}"
        )


def plan_of(
    adapted: PlanAdapter | None, metadata: Mapping[str, str], outputs: Sequence[str]
) -> PlanAdapter:
    """Return the adapter's reading of the plan, or else the metadata's."""
    # the plan and the scores that pick its mode must be outputs
    found = adapted or PlanAdapter.of(metadata, outputs)
    there = ", ".join(outputs)
    if found is None:
        raise EvaluationError(
            f"the model has no output plan, and no adapter or metadata names one; "
            f"there are {there}"
        )
    if found.output not in outputs:
        raise EvaluationError(
            f"no output {found.output}, which is named as the plan; there are {there}"
        )
    if found.scores is not None and found.scores not in outputs:
        raise EvaluationError(
            f"no output {found.scores}, which is named as the scores; there are {there}"
        )
    return found


# Plan and state, as a module map or an adapter state them, as metadata of a graph.


Given: TypeAlias = str | Path | None


def adapted(
    model: ir.Model, adapter: Given, module_map: Given = None
) -> dict[str, str]:
    """Write what a map and an adapter state of plan and state into a graph's metadata.

    The adapter is a TOML file or the name of one that ships, and overrides the map, a
    preset or a TOML file; None changes nothing. The metadata that were written are
    returned, for a session that opens the file itself. What does not fit the graph
    raises EvaluationError.
    """
    said = dict[str, str]()
    if module_map is not None:
        modules = ModuleMap.load(str(module_map))
        for ports in (*modules.optional, modules.ports):
            said |= _stated(model, modules, ports, said)
    if adapter is not None:
        found = Adapter.load(adapter_file(Path(adapter)))
        inputs = [str(each.name) for each in model.graph.inputs]
        # every input that the adapter names must exist
        for name in (*found.feeds, *found.images):
            if name not in inputs:
                raise EvaluationError(
                    f"adapter {adapter}: it feeds input {name}; there are"
                    f" {', '.join(inputs)}"
                )
        said |= found.metadata({**model.metadata_props, **said})
        _check_stated(model, f"adapter {adapter}", found.plan, said)
    model.metadata_props.update(said)
    return said


def _stated(
    model: ir.Model, modules: ModuleMap, ports: Ports, before: Mapping[str, str]
) -> dict[str, str]:
    """Return the metadata that a map states; none where optional ports do not fit."""
    own, plan = {**model.metadata_props, **before}, ports.plan
    pairs, is_optional = dict(ports.recurrent), ports is not modules.ports
    if is_optional:  # the graph's own metadata come first
        declared, plan = declared_pairs(own), None if PLAN in own else plan
        free = {
            name: out for name, out in pairs.items() if name not in (declared or {})
        }
        pairs = {} if declared == {} else free
    if plan is None and not pairs:
        return {}
    origin = f"map {modules.name}"
    found = Adapter.parse({"plan": plan, "recurrent": pairs}, origin)
    said = found.metadata(own)
    try:
        _check_stated(model, origin, found.plan, said)
        if found.plan is not None:
            check_command(found.plan, [str(each.name) for each in model.graph.inputs])
    except EvaluationError as error:
        if is_optional:
            return {}
        words = str(error).removeprefix(f"{origin}: ")
        raise EvaluationError(f"{origin}: {words}") from error
    return said


def _check_stated(
    model: ir.Model, origin: str, plan: PlanAdapter | None, said: Mapping[str, str]
) -> None:
    """Check that plan and recurrent state are found under the new metadata."""
    outputs = [str(each.name) for each in model.graph.outputs]
    try:
        if plan is not None:
            plan_of(plan, {}, outputs)
        recurrence({**model.metadata_props, **said}, *sides(model))
    except (EvaluationError, GraphError) as error:
        raise EvaluationError(f"{origin}: {error}") from error
