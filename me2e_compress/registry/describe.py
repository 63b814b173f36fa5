"""What can be told of a class whose fields are its options."""

import dataclasses
import inspect
import re
from collections.abc import Mapping
from typing import Any

from me2e_compress.registry.text import write_value

_PATH = re.compile(r"[A-Za-z_][\w.]*\.(?=[A-Za-z_])")
"""The module before a name, in a type."""
_SECTION = re.compile(r"\n(?:Attributes|Args):\n((?:[ \t]+.*\n?|\n)+)")
_OPTION = re.compile(r"^    (\w+): ((?:.|\n(?=      ))+)", re.MULTILINE)


@dataclasses.dataclass(frozen=True)
class Option:
    """One option of an entry.

    Attributes:
        name: of the field.
        type: as it is written in Python.
        default: as it is written in text; None where it must be given.
        doc: what the docstring says of it; empty where it says nothing.
    """

    name: str
    type: str
    default: str | None
    doc: str


@dataclasses.dataclass(frozen=True)
class Entry:
    """One name of a registry.

    Attributes:
        name: what recipes and the command line call it.
        source: the package that brings it, with its version; of a name that several
            packages claim, all of them.
        doc: first line of its docstring.
        options: in the order of its fields.
        error: why it cannot be used; empty if it can.
    """

    name: str
    source: str
    doc: str = ""
    options: tuple[Option, ...] = ()
    error: str = ""


def first_line(cls: type) -> str:
    """Return the first line of a docstring, empty without one."""
    return (inspect.getdoc(cls) or "").partition("\n")[0]


def fields_of(cls: type) -> tuple["dataclasses.Field[Any]", ...]:
    """Return the fields of a dataclass that are its options, those by keyword last."""
    fields = [field for field in dataclasses.fields(cls) if field.init]
    return tuple(sorted(fields, key=lambda field: field.kw_only is True))


def options_of(cls: type) -> tuple[Option, ...]:
    """Describe the options of a dataclass, in the order of its fields."""
    docs = _docs(cls)
    return tuple(
        Option(
            field.name,
            _type(field.type),
            write_value(default_of(field)) if has_default(field) else None,
            docs.get(field.name, ""),
        )
        for field in fields_of(cls)
    )


def has_default(field: "dataclasses.Field[Any]") -> bool:
    """Return whether an option may be left out."""
    missing = dataclasses.MISSING
    return field.default is not missing or field.default_factory is not missing


def default_of(field: "dataclasses.Field[Any]") -> object:
    """Return what an option is where it is left out; MISSING where it may not be."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _type(annotation: object) -> str:
    if not isinstance(annotation, str):
        annotation = inspect.formatannotation(annotation)
    return _PATH.sub("", annotation)


def _docs(cls: type) -> Mapping[str, str]:
    """Return what the section Attributes (or Args) says, by field."""
    section = _SECTION.search((inspect.getdoc(cls) or "") + "\n")
    if section is None:
        return {}
    return {
        name: " ".join(text.split()) for name, text in _OPTION.findall(section.group(1))
    }
