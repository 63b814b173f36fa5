"""Which outputs of a model are read, and how."""

from collections.abc import Mapping, Sequence

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.plan_adapter import PlanAdapter


def plan_of(
    adapted: PlanAdapter | None, metadata: Mapping[str, str], outputs: Sequence[str]
) -> PlanAdapter:
    """Return the adapter's reading of the plan, or else the model's own.

    Args:
        adapted: What the adapter says of it.
        metadata: Of the model.
        outputs: Of the model, by name.

    Raises:
        EvaluationError: Nothing names the plan, or the model has no such output.
    """
    found = adapted or PlanAdapter.of(metadata, outputs)
    there = ", ".join(outputs)
    if found is None:
        raise EvaluationError(
            f"the model has no output plan, and no adapter or metadata names one; "
            f"there are {there}"
        )
    if found.output not in outputs:
        raise EvaluationError(
            f"no output {found.output}, which the adapter names as the plan; there "
            f"are {there}"
        )
    if found.scores is not None and found.scores not in outputs:
        raise EvaluationError(
            f"no output {found.scores}, which the adapter names as the scores; "
            f"there are {there}"
        )
    return found
