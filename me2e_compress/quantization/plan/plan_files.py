"""Plans on disk, in a model, and side by side."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import onnx_ir as ir
import pydantic

from me2e_compress.errors import RecipeError
from me2e_compress.quantization.plan.decision import Decision, QuantPlan
from me2e_compress.runtime.atomic import write_json

METADATA = "me2e.quant_plan"
"""Key of the model's metadata under which a quantized graph carries its plan."""


def record(plan: QuantPlan) -> dict[str, object]:
    """Give a plan as JSON data."""
    return dataclasses.asdict(plan)


def save_plan(plan: QuantPlan, path: Path) -> None:
    """Write a plan as JSON, all or nothing."""
    write_json(path, record(plan), indent=1)


def load_plan(path: Path) -> QuantPlan:
    """Read what :func:`save_plan` wrote.

    Raises:
        RecipeError: no such file, or not a plan.
    """
    if not path.is_file():
        raise RecipeError(f"{path}: no such plan")
    return _parse(path.read_bytes(), str(path))


def stamp_plan(model: ir.Model, plan: QuantPlan) -> None:
    """Write a plan into a model's metadata."""
    model.metadata_props[METADATA] = json.dumps(record(plan), separators=(",", ":"))


def plan_of(model: ir.Model) -> QuantPlan | None:
    """Read the plan that a model was quantized by; None if it carries none.

    Raises:
        RecipeError: what it carries is not a plan.
    """
    text = model.metadata_props.get(METADATA)
    return None if text is None else _parse(text, "the plan in the model's metadata")


@dataclasses.dataclass(frozen=True)
class PlanDifference:
    """One node that two plans decide differently.

    Attributes:
        old: its decision in the first plan; None if that has no such node.
        new: in the second.
    """

    old: Decision | None
    new: Decision | None

    def __str__(self) -> str:
        """Show both decisions on one line."""
        either = self.new or self.old
        name = "" if either is None else either.node or either.output
        return f"{name}: {_short(self.old)} -> {_short(self.new)}"


def differences(old: QuantPlan, new: QuantPlan) -> Iterator[PlanDifference]:
    """Compare two plans node by node: dtype and rule, in the order of the second."""
    before = {each.output: each for each in old.decisions}
    after = {each.output: each for each in new.decisions}
    for output in (*after, *(name for name in before if name not in after)):
        left, right = before.get(output), after.get(output)
        if left is None or right is None or _key(left) != _key(right):
            yield PlanDifference(left, right)


def _key(decision: Decision) -> tuple[str, str]:
    return decision.dtype, decision.rule


def _short(decision: Decision | None) -> str:
    return "none" if decision is None else f"{decision.dtype} ({decision.rule})"


def _parse(text: str | bytes, origin: str) -> QuantPlan:
    try:
        return pydantic.TypeAdapter(QuantPlan).validate_json(text)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "file"
        raise RecipeError(f"{origin}: not a plan: {where}: {first['msg']}") from error
