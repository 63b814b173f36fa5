"""Check that the planner still depends on the cameras after an ablation."""

import onnx_ir as ir

from me2e_compress.errors import PreconditionError
from me2e_compress.graph import provenance
from me2e_compress.modules import ModuleMap
from me2e_compress.passes.substitutes import module_of

PLANNER = "planner"
"""The module that makes the plan, in every preset."""


def seeing(model: ir.Model, modules: ModuleMap) -> tuple[str, ...]:
    """Return the planner's outputs that depend on the feature extraction."""
    features = set(modules.names("feature"))
    return tuple(
        str(value.name)
        for value in model.graph.outputs
        if module_of(value) == PLANNER and _depends(value, features)
    )


def check_sight(
    model: ir.Model, modules: ModuleMap, before: tuple[str, ...], drop: tuple[str, ...]
) -> None:
    """Raise a PreconditionError unless the plan still depends on the cameras."""
    blind = [name for name in before if name not in seeing(model, modules)]
    if blind:
        features = ", ".join(modules.names("feature"))
        how = f"without {', '.join(drop)}" if drop else "by these edges"
        raise PreconditionError(
            f"{how} the plan is cut: {blind[0]} depends on nothing of {features} any"
            f" more; keep a module, or add an edge to the {PLANNER}"
        )


def _depends(value: ir.Value, features: set[str]) -> bool:
    queue, seen = [value.producer()], {value.producer()}
    while queue:
        node = queue.pop()
        if node is None:
            continue
        if provenance.module_of(node) in features:
            return True
        for each in node.predecessors():
            if each not in seen:
                seen.add(each)
                queue.append(each)
    return False
