"""Drive variants by an evaluator other than highway-env."""

from me2e_compress.metrics.episode import Episode
from me2e_compress.study.condition import Condition
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.study.workspace import Workspace
from me2e_compress.workflows.other_evaluators import (
    driven_episodes,
    evaluator_named,
    keep,
    kept,
)


def episodes_elsewhere(
    evaluator: str,
    prepared: PreparedVariant,
    condition: Condition,
    workspace: Workspace,
) -> tuple[Episode, ...]:
    """Return the episodes of a variant, from its folder if they were kept.

    ``evaluator`` is its name and options; the policy becomes its option ``policy``.
    """
    model = prepared.model
    policy = prepared.variant.policy if model is None else str(model)
    found = evaluator_named(evaluator, policy)
    folder = workspace.results(prepared.variant, condition)
    driver = prepared.sha256 or prepared.driver.fingerprint()
    if (again := kept(found, folder, driver)) is not None:
        return again
    episodes = driven_episodes(found)
    keep(found, episodes, folder, driver)
    return episodes
