"""Plan and state, as a module map or an adapter state them, as metadata of a graph."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress.driving.adapter.adapter import Adapter
from me2e_compress.driving.adapter.outputs import check_command, plan_of
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.graph.modules.module_map import Ports
from me2e_compress.graph.recurrence import declared_pairs, recurrence, sides
from me2e_compress.runtime.plan_adapter import PLAN, PlanAdapter

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
