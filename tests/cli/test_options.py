"""One spelling for one option in all commands."""

import importlib
import re
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest
from typer.models import ArgumentInfo, OptionInfo

from me2e_compress.cli.app import COMMANDS

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
    for name, entry in COMMANDS.items():
        home = importlib.import_module(f"me2e_compress.cli.commands.{name}")
        function = getattr(home, entry.function)
        hints = typing.get_type_hints(function, include_extras=True)
        for given, hint in hints.items():
            if typing.get_origin(hint) is Annotated:
                type_, info = typing.get_args(hint)
                yield Parameter(name, spelling(given, info), plain(type_), info.help)


def spelling(name: str, info: ArgumentInfo | OptionInfo) -> str:
    if isinstance(info, ArgumentInfo):
        return name
    decls = (info.default, *(info.param_decls or ()))  # the first stands there
    long = [each for each in decls if str(each).startswith("--")]
    return str(long[0]) if long else "--" + name.replace("_", "-")


def plain(type_: Any) -> object:
    """Leave None out: whether an option may be absent is each command's own."""
    if not isinstance(type_, types.UnionType):
        return type_
    (rest,) = (each for each in typing.get_args(type_) if each is not type(None))
    return rest


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
        *("doctor", "list", "inspect", "lint", "compare", "ranges", "score"),
    }
    assert not [each for each in FOUND if each.type is Path and each.name == "--out"]
