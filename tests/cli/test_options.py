"""One spelling for one option in all commands."""

import re
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any

import pytest

from me2e_compress.cli.app import COMMANDS, app

OWN = {"--output": "the ", "stack": ""}
"""Names whose help is each command's own, and how it begins."""


@dataclass(frozen=True)
class Parameter:
    command: str
    name: str
    type: object
    help: str

    @property
    def stem(self) -> str:
        """What the option is, before what this command says of its values."""
        return re.split(r"[:;,(]", self.help)[0].strip()


def parameters() -> Iterator[Parameter]:
    for name in COMMANDS:
        for each in app[name].assemble_argument_collection(parse_docstring=True):
            if each.parse and each.name != "*":
                spelling = each.name if each.name.startswith("-") else each.name.lower()
                help_text = each.parameter.help or ""
                yield Parameter(name, spelling, plain(each.hint), help_text)


def plain(type_: Any) -> frozenset[object]:
    """Leave None out, which is each command's own; a file is a text."""
    leaves = typing.get_args(type_) or (type_,)
    return frozenset(str if each is Path else each for each in leaves) - {NoneType}


FOUND = list(parameters())
NAMES = sorted({each.name for each in FOUND} - OWN.keys())


@pytest.mark.parametrize("name", NAMES)
def test_a_name_stands_for_one_thing(name: str) -> None:
    same = [each for each in FOUND if each.name == name]

    assert len({str(each.type) for each in same}) == 1, same
    assert len({each.stem for each in same}) == 1, same


def test_a_thing_has_one_name() -> None:
    names: dict[tuple[str, str], set[str]] = {}
    for each in FOUND:
        kind = "option" if each.name.startswith("-") else "argument"
        names.setdefault((kind, each.stem), set()).add(each.name)

    assert {stem: found for stem, found in names.items() if len(found) > 1} == {}


@pytest.mark.parametrize("name", OWN)
def test_help_of_their_own_begins_alike(name: str) -> None:
    same = [each for each in FOUND if each.name == name]

    assert all(each.help.startswith(OWN[name]) for each in same)


def test_what_a_command_writes_is_its_output() -> None:
    writers = {each.command for each in FOUND if each.name == "--output"}

    assert writers == set(COMMANDS) - {
        *("doctor", "list", "inspect", "lint", "compare", "score")
    }
