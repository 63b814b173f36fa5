"""Drivers as users name them."""

from dataclasses import replace
from pathlib import Path

from me2e_compress.cli.models import model_path
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.evaluators.highway.drivers import BLIND, EXPERT, Driver


def driver_of(text: str, adapter: Path | None = None) -> Driver:
    """Give the driver that a word of the command line means, its model found.

    Args:
        text: ``expert``, ``blind``, ``blind:S``, a path, or a shipped model's name.
        adapter: TOML file that adapts the model to the policy contract.

    Raises:
        EvaluationError: none of them.
    """
    driver = Driver(text, adapter)
    if not driver.is_model:
        return driver
    try:
        return replace(driver, name=str(model_path(text)))
    except GraphError as error:
        raise EvaluationError(f"{error}; or {EXPERT}, {BLIND}") from error
