"""Convert a graph's outputs to a policy's answer."""

import contextlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import EvaluationError, GraphError
from me2e_compress.driving.adapter.adapter import ZEROS, Adapter, ModelInputs
from me2e_compress.driving.contract import Shape
from me2e_compress.driving.input_sources import INPUT_SOURCES
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.graph.modules.module_map import ModuleMap, Ports
from me2e_compress.graph.recurrence import (
    RECURRENT,
    SETS,
    declared_pairs,
    recurrence,
    recurrent_inputs,
    sides,
)
from me2e_compress.runtime.plan_adapter import PLAN, PlanAdapter
from me2e_compress.runtime.session import DTYPES, Session, SessionPort, zero_state

COMMAND = "command"  # name of the navigator's command among the inputs


def find_plan(session: Session, adapter: Adapter) -> PlanAdapter:
    """Return how the plan of a graph is read, checked against its ports."""
    plan = plan_of(adapter.plan, session.metadata, list(session.outputs))
    check_command(plan, session.inputs)
    return plan


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
    plan = adapted or PlanAdapter.of(metadata, outputs)
    there = ", ".join(outputs)
    if plan is None:
        raise EvaluationError(
            f"the model has no output plan, and no adapter or metadata names one; "
            f"there are {there}"
        )
    for what, name in (("plan", plan.output), ("scores", plan.scores)):
        if name is not None and name not in outputs:
            raise EvaluationError(
                f"no output {name}, which is named as the {what}; there are {there}"
            )
    return plan


# Plan and state, as a module map or an adapter state them, as metadata of a graph.


Given: TypeAlias = str | Path | None


def write_port_metadata(
    model: ir.Model, adapter: Given, module_map: Given = None
) -> dict[str, str]:
    """Write what a map and an adapter state of plan and state into a graph's metadata.

    The adapter is a TOML file or the name of one that ships, and overrides the map, a
    preset or a TOML file; None changes nothing. The metadata that were written are
    returned, for a session that opens the file itself. What does not fit the graph
    raises EvaluationError.
    """
    metadata = dict[str, str]()
    if module_map is not None:
        modules = ModuleMap.load(str(module_map))
        for ports in (*modules.optional, modules.ports):
            metadata |= _of_map(model, modules, ports, metadata)
    # The adapter overrides the map
    if adapter is not None:
        adapter_of = Adapter.load(adapter_file(Path(adapter)))
        inputs = [str(value.name) for value in model.graph.inputs]
        for name in (*adapter_of.feeds, *adapter_of.images):
            if name not in inputs:
                raise EvaluationError(
                    f"adapter {adapter}: it feeds input {name}; there are"
                    f" {', '.join(inputs)}"
                )
        metadata |= adapter_of.metadata({**model.metadata_props, **metadata})
        _check_fit(model, f"adapter {adapter}", adapter_of.plan, metadata)
    model.metadata_props.update(metadata)
    return metadata


def state_and_plan(
    model: ir.Model,
    path: Path,
    adapter: Given,
    module_map: Given,
    others: Mapping[Path, Mapping[str, str]],
) -> tuple[dict[str, str], str]:
    """Return what is known of state and plan beside a graph's metadata, and from where.

    What neither adapter, map nor own metadata state is taken from the metadata of
    `others`, if the graph has what they name. It is written into the graph's metadata
    and returned; see `write_port_metadata`.
    """
    # In the order in which one overrides the others
    sources = [(f"metadata of {path.name}", dict(model.metadata_props))]
    for other, metadata in others.items():
        lent = _lent(model, metadata)
        model.metadata_props.update(lent)
        sources.append((f"metadata of {other.name}", lent))
    for origin, files in (("map", (None, module_map)), ("adapter", (adapter, None))):
        named = Path(str(files[0] or files[1])).name
        sources.append((f"{origin} {named}", write_port_metadata(model, *files)))
    added = {key: text for _, own in sources[1:] for key, text in own.items()}
    # What is known, by the source that states it last
    pairs, plan = dict[str, tuple[str | None, str]](), ("", "its name")
    for origin, own in sources:
        for name, answer in (declared_pairs(own) or {}).items():
            if pairs.get(name, ("", ""))[0] != answer:
                pairs[name] = answer, origin
        if own.get(PLAN, plan[0]) != plan[0]:
            plan = own[PLAN], origin
    # Inputs and plan in words, by their source
    known = dict[str, list[str]]()
    for name in recurrent_inputs(model):
        _, origin = pairs.get(name, ("", "its name"))
        there = known.setdefault(origin, [])
        there.append(name if there else f"state {name}")
    outputs = [str(output.name) for output in model.graph.outputs]
    if (own_plan := PlanAdapter.of(model.metadata_props, outputs)) is not None:
        known.setdefault(plan[1], []).append(f"plan {own_plan.output}")
    return added, "; ".join(f"{', '.join(own)}: {at}" for at, own in known.items())


def _lent(model: ir.Model, metadata: Mapping[str, str]) -> dict[str, str]:
    """Return what another graph's metadata state, and this one's lack, that fits it."""
    (inputs, outputs), own = sides(model), model.metadata_props
    lent, ends = dict[str, str](), (None, *outputs)
    # Pairs of which this graph has both names, and a plan that it answers
    if RECURRENT not in own and (pairs := declared_pairs(metadata)) is not None:
        fit = {k: end for k, end in pairs.items() if k in inputs and end in ends}
        if fit or not pairs:
            lent[RECURRENT] = json.dumps(fit)
    if PLAN in metadata and PLAN not in own:
        with contextlib.suppress(GraphError):  # it reads outputs that are not here
            plan = PlanAdapter.of(metadata, list(outputs))
            if plan is not None and plan.command_input in (None, COMMAND, *inputs):
                lent[PLAN] = metadata[PLAN]
    return lent


def _of_map(
    model: ir.Model, modules: ModuleMap, ports: Ports, before: Mapping[str, str]
) -> dict[str, str]:
    """Return the metadata that a map states; none where optional ports do not fit."""
    own, plan = {**model.metadata_props, **before}, ports.plan
    pairs, is_optional = dict(ports.recurrent), ports is not modules.ports
    # The graph's own metadata override ports that are optional
    if is_optional:
        declared, plan = declared_pairs(own), None if PLAN in own else plan
        known = declared or {}
        pairs = {name: out for name, out in pairs.items() if name not in known}
        pairs = {} if declared == {} else pairs
    sets = {} if SETS in own or not ports.sets else {SETS: json.dumps(ports.sets)}
    if plan is None and not pairs and not sets:
        return {}
    # State the rest as an adapter would
    origin = f"map {modules.name}"
    adapter = Adapter.parse({"plan": plan, "recurrent": pairs}, origin)
    metadata = adapter.metadata(own) | sets
    # Every name must be one of the graph's
    try:
        _check_fit(model, origin, adapter.plan, metadata)
        outputs = [str(output.name) for output in model.graph.outputs]
        for name in np.hstack([np.array([], str), *ports.sets.values()]):
            if name not in outputs:
                raise EvaluationError(f"{origin}: sets: no output {name}")
        if adapter.plan is not None:
            inputs = [str(value.name) for value in model.graph.inputs]
            check_command(adapter.plan, inputs)
    except EvaluationError as error:
        if is_optional:
            return {}
        words = str(error).removeprefix(f"{origin}: ")
        raise EvaluationError(f"{origin}: {words}") from error
    return metadata


def _check_fit(
    model: ir.Model, origin: str, plan: PlanAdapter | None, metadata: Mapping[str, str]
) -> None:
    """Check that the graph has the plan and recurrent state of the new metadata."""
    outputs = [str(output.name) for output in model.graph.outputs]
    try:
        if plan is not None:
            plan_of(plan, {}, outputs)
        recurrence({**model.metadata_props, **metadata}, *sides(model))
    except (EvaluationError, GraphError) as error:
        # The map or adapter is to blame, not the graph
        words = str(error).replace(f"metadata {RECURRENT}", "[recurrent]")
        raise EvaluationError(f"{origin}: {words}") from error


# The use of each input and output of a graph, whether or not it could drive.


@dataclass(frozen=True)
class PortUse:
    """One input or output of a graph, and its part in driving."""

    name: str
    shape: Shape
    type: str  # of its elements, like int64
    use: str | None  # an input's feed or how an output is read; None for nothing
    problem: str = ""  # why the model cannot drive so; empty where it can


def input_uses(
    session: Session, adapter: Adapter, recurrent: Mapping[str, str]
) -> tuple[PortUse, ...]:
    """List the inputs of a graph, in its order, with what each is fed."""
    inputs, problems = ModelInputs.opened(session, adapter, recurrent)
    # Each input's feed in words
    words = {name: f"{own} of the frame before" for name, own in recurrent.items()}
    for name, table in inputs.tables.items():
        cameras = ", ".join(table.cameras)
        words[name] = "the six cameras" if len(table.cameras) == 6 else cameras
        words[name] += ", side by side" if table.stitch else ""
    for name, feed in inputs.sources.items():
        words[name] = ", ".join(INPUT_SOURCES.text(part.source) for part in feed.parts)
    # Faults of types and first values
    for name, port in session.inputs.items():
        if port.type not in DTYPES:
            problems[name] = f"input {name} is {port.type}: it cannot be fed"
        elif name in recurrent:
            entry = (adapter.recurrent or {}).get(name)
            if entry is None or entry.first == ZEROS:
                try:
                    zero_state(name, port)
                except GraphError as error:
                    problems[name] = str(error)
    return _uses(session.inputs, words, problems)


def _uses(
    ports: Mapping[str, SessionPort],
    words: Mapping[str, str],
    problems: Mapping[str, str],
) -> tuple[PortUse, ...]:
    uses = list[PortUse]()
    for name, port in ports.items():
        element = port.type.removeprefix("tensor(").removesuffix(")")
        use, problem = words.get(name), problems.get(name, "")
        uses.append(PortUse(name, port.shape, element, use, problem))
    return tuple(uses)


def output_uses(
    session: Session, adapter: Adapter, recurrent: Mapping[str, str]
) -> tuple[tuple[PortUse, ...], str]:
    """List a graph's outputs, and a line on why none is the plan, empty if one is."""
    uses = {answer: f"fed back to {name}" for name, answer in recurrent.items()}
    problem = ""
    try:
        plan = find_plan(session, adapter)
    except (EvaluationError, GraphError) as error:
        problem = str(error)
    else:
        uses[plan.output] = "the plan"
        if plan.scores is not None:
            uses[plan.scores] = "scores, which pick the plan's mode"
    return _uses(session.outputs, uses, {}), problem
