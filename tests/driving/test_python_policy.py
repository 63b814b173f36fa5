"""Policies that a function of a user's own module makes."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import Policy
from me2e_compress.driving.policies import Driver, PythonDriver, driver_named, opened
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.testing import check_policy
from models.driver.expert.blind import Blind, BlindDriver
from tests.support.installed import install

Write = Callable[[str], str]

BLIND = """
from models.driver.expert.blind import Blind
from models.driver.expert.blind import BlindDriver

def make():
    return Blind(5.0)

def driver():
    return BlindDriver(6.0)
"""


@pytest.fixture
def write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Write:
    """Write a module into the working folder, and name it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    name = "policy_" + "".join(c if c.isalnum() else "_" for c in request.node.name)

    def written(text: str) -> str:
        (tmp_path / f"{name}.py").write_text(text)
        return name

    return written


def test_a_function_of_the_working_folder_makes_a_policy_or_a_driver(
    write: Write,
) -> None:
    module = write(BLIND)

    driver = driver_named(f"{module}:make")

    assert driver == PythonDriver(f"{module}:make")
    assert driver.label == f"{module}:make"
    assert driver.open() == Blind(5.0)
    assert len(check_policy(driver)) == 8
    assert driver_named(f"{module}:driver").open() == Blind(6.0)


def test_results_know_it_by_its_code(write: Write) -> None:
    driver = driver_named(f"{write(BLIND)}:make")
    before = driver.fingerprint()

    assert write(BLIND + "# new") in before
    assert driver.fingerprint() != before


def test_names_and_files_win(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models:best").write_bytes(b"")

    assert driver_named("blind:8") == BlindDriver(8.0)
    assert driver_named("models:best") == OnnxDriver(Path("models:best"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import nowhere_at_all", "ModuleNotFoundError: No module named 'nowhere_at"),
        ("make = 3", "has no function make"),
        ("other = 3", "has no function make"),
        ("def make(): raise KeyError('weights')", "KeyError: 'weights'"),
        ("def make(speed): return speed", "TypeError: make.. missing 1 required"),
        ("make = dict", "a dict is no policy: it has no needs_images, privileged, res"),
        ("def make(:", "SyntaxError: "),
    ],
)
def test_what_makes_no_policy_is_one_line(
    write: Write, text: str, message: str
) -> None:
    module = write(text)

    with pytest.raises(EvaluationError, match=message) as caught:
        opened(driver_named(f"{module}:make"))
    assert str(caught.value).startswith(f"policy {module}:make: ")
    assert "\n" not in str(caught.value)


@dataclass(frozen=True)
class Undrivable:
    """Has a name, and is no driver."""

    name: ClassVar[str] = "undrivable"


def test_an_entry_point_that_is_no_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = {"undrivable": f"{__name__}:Undrivable"}
    install(monkeypatch, tmp_path, "a-policy", "me2e_compress.policies", entry)

    with pytest.raises(EvaluationError, match="a Undrivable, which is no Driver"):
        driver_named("undrivable")


@dataclass(frozen=True)
class Empty(Driver):
    """Opens nothing that drives."""

    name: ClassVar[str] = "empty"

    def open(self) -> Policy:
        return object()  # type: ignore[return-value]


def test_a_driver_that_opens_no_policy_and_another_form_are_refused() -> None:
    with pytest.raises(EvaluationError, match="empty: a object is no policy: it has"):
        opened(Empty())
    with pytest.raises(EvaluationError, match=r"not of the form package\.module:func"):
        driver_named("python:here")
