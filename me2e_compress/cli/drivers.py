"""Drivers as users name them."""

from dataclasses import replace
from pathlib import Path

from me2e_compress.cli.models import model_path
from me2e_compress.driving.policies import POLICIES, Driver, driver_named
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.evaluators.highway.drivers import OnnxDriver


def driver_of(text: str, adapter: Path | None = None) -> Driver:
    """Return the driver that a word of the command line means, its model found.

    Args:
        text: a policy by name, a path, or a shipped model's name.
        adapter: TOML file that adapts the model to the policy contract.

    Raises:
        EvaluationError: none of them.
    """
    driver = driver_named(text, adapter)
    if not isinstance(driver, OnnxDriver):
        return driver
    try:
        return replace(driver, path=model_path(str(driver.path)))
    except GraphError as error:
        policies = ", ".join(POLICIES.names())
        raise EvaluationError(f"{error}; policies: {policies}") from error
