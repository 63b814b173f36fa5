"""The public names are those of ``public_names.txt``: none comes or goes unseen.

After a change that is meant: ``python -m tests.docs.test_public_names``.
"""

import importlib
import inspect
import re
from enum import Enum
from pathlib import Path

import pytest

import me2e_compress
from me2e_compress.cli.app import COMMANDS
from tests.docs.pages import ROOT

LIST = Path(__file__).with_name("public_names.txt")
ROOMS = (
    "me2e_compress",
    "me2e_compress.calibration.observers",
    "me2e_compress.driving.contract",
    "me2e_compress.driving.input_sources",
    "me2e_compress.driving.latency",
    "me2e_compress.driving.policies",
    "me2e_compress.errors",
    "me2e_compress.evaluators",
    "me2e_compress.graph",
    "me2e_compress.manager",
    "me2e_compress.metrics.episode",
    "me2e_compress.graph.modules",
    "me2e_compress.operators",
    "me2e_compress.passes",
    "me2e_compress.quantization.plan",
    "me2e_compress.quantization.rules",
    "me2e_compress.manager.recipe",
    "me2e_compress.registry",
    "me2e_compress.graph.rewrite",
    "me2e_compress.fidelity.sensitivity",
    "me2e_compress.study",
    "me2e_compress.targets",
    "me2e_compress.testing",
)


def public_names(room: str) -> list[str]:
    return sorted(importlib.import_module(room).__all__)


def held() -> dict[str, list[str]]:
    lines = LIST.read_text(encoding="utf-8").splitlines()
    found = dict[str, list[str]]()
    for line in lines:
        room, _, name = line.partition(": ")
        found.setdefault(room, []).append(name)
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_the_public_names_of_a_room_are_those_of_the_list(room: str) -> None:
    assert public_names(room) == held()[room]


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_name_is_there(room: str) -> None:
    module = importlib.import_module(room)
    missing = [name for name in public_names(room) if not hasattr(module, name)]
    assert missing == []


@pytest.mark.parametrize("room", ROOMS)
def test_a_signature_shows_no_address(room: str) -> None:
    module = importlib.import_module(room)
    shown = {
        name: str(inspect.signature(each))
        for name in public_names(room)
        if inspect.isroutine(each := getattr(module, name))
        or (inspect.isclass(each) and not issubclass(each, Enum | Exception))
    }
    assert [name for name, text in shown.items() if " at 0x" in text] == []


def test_the_package_page_tells_the_function_of_every_command() -> None:
    page = (ROOT / "docs" / "package.md").read_text(encoding="utf-8")
    (told,) = (line for line in page.splitlines() if line.startswith("In Python "))
    functions, others = told.split(" are commands alone")[0].rsplit(". ", 1)
    names = set(re.findall(r"`(\w+)`", functions))
    without = set(re.findall(r"`(\w+)`", others))

    assert {*names, *without} >= COMMANDS.keys()
    assert names - {"frames", "sensitivity", "study"} <= set(me2e_compress.__all__)
    assert not without & set(me2e_compress.__all__)


def test_a_name_that_is_none_is_an_error() -> None:
    """And one for mypy, which would call the comment unused (``make check``)."""
    with pytest.raises(AttributeError, match="me2e_compress has no nothing"):
        _ = me2e_compress.nothing  # type: ignore[attr-defined]


if __name__ == "__main__":
    lines = [f"{room}: {name}\n" for room in ROOMS for name in public_names(room)]
    LIST.write_text("".join(lines), encoding="utf-8")
