"""The entries of a registry, described: where from, and with which options."""

import dataclasses
import inspect
import re
from collections.abc import Mapping
from typing import Any, TypeVar

from me2e_compress.errors import Me2eError
from me2e_compress.registry.registry import NamedItem, Registry, default_of, fields_of
from me2e_compress.registry.text import write_value

T = TypeVar("T", bound=NamedItem)

_PATH = re.compile(r"[A-Za-z_][\w.]*\.(?=[A-Za-z_])")
"""The module before a name, in a type."""
_SECTION = re.compile(r"\n(?:Attributes|Args):\n((?:[ \t]+.*\n?|\n)+)")
_OPTION = re.compile(r"^    (\w+): ((?:.|\n(?=      ))+)", re.MULTILINE)


@dataclasses.dataclass(frozen=True)
class Option:
    """One option of an entry.

    Attributes:
        name: of the field.
        type: as in Python.
        default: as text; None where it must be given.
        doc: of the docstring; empty where it says nothing.
    """

    name: str
    type: str
    default: str | None
    doc: str


@dataclasses.dataclass(frozen=True)
class Entry:
    """One name of a registry.

    Attributes:
        name: as in recipes and commands.
        source: the package; with its version; of a name that several
            packages claim, all of them.
        doc: first line of its docstring.
        options: in order; that of its fields.
        error: why it cannot be used; empty if it can.
    """

    name: str
    source: str
    doc: str = ""
    options: tuple[Option, ...] = ()
    error: str = ""


def describe(registry: Registry[T]) -> tuple[Entry, ...]:
    """Describe every entry of a registry; what cannot be used says why."""
    return tuple(_entry(registry, name) for name in registry.names())


def options_of(cls: type) -> tuple[Option, ...]:
    """Describe the options of a dataclass, in the order of its fields."""
    docs = _docs(cls)
    return tuple(
        Option(
            field.name,
            _type(field.type),
            write_value(default_of(field)) if _has_default(field) else None,
            docs.get(field.name, ""),
        )
        for field in fields_of(cls)
    )


def _has_default(field: "dataclasses.Field[Any]") -> bool:
    """Return whether an option may be left out."""
    missing = dataclasses.MISSING
    return field.default is not missing or field.default_factory is not missing


def _type(annotation: object) -> str:
    if not isinstance(annotation, str):
        annotation = inspect.formatannotation(annotation)
    return _PATH.sub("", annotation)


def _docs(cls: type) -> Mapping[str, str]:
    """Return what the section Attributes (or Args) says, by field; a base's, too."""
    found = dict[str, str]()
    for each in reversed(cls.__mro__):
        section = _SECTION.search(inspect.cleandoc(each.__doc__ or "") + "\n")
        options = [] if section is None else _OPTION.findall(section.group(1))
        found |= {name: " ".join(text.split()) for name, text in options}
    return found


def _entry(registry: Registry[T], name: str) -> Entry:
    source = " and ".join(registry.sources(name))
    try:
        cls = registry.get(name)
    except Me2eError as error:
        return Entry(name, source, error=str(error))
    first_line = (inspect.getdoc(cls) or "").partition("\n")[0]
    return Entry(name, source, first_line, options_of(cls))
