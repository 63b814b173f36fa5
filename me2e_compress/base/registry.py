"""Classes by name; the fields of a class are its options."""

import contextlib
import dataclasses
import functools
import importlib.metadata
import inspect
import re
import sys
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint
from typing import Any, ClassVar, Generic, Protocol, TypeVar, get_type_hints

import pydantic
from pydantic_core import CoreSchema, core_schema

from me2e_compress.base.display import with_prefix
from me2e_compress.base.errors import Me2eError
from me2e_compress.base.text import (
    ParsedItem,
    TextError,
    name_in,
    read_all,
    read_one,
    write_item,
    write_value,
)

_OURS = "me2e-compress"


class NamedItem(Protocol):
    """What is registered: a frozen dataclass with a name for texts."""

    name: ClassVar[str]


T = TypeVar("T", bound=NamedItem)


@dataclasses.dataclass(frozen=True)
class Registry(Generic[T]):
    """Classes by name: ours, then those of the entry points of other packages.

    A class is a frozen dataclass: its ``name`` is the name it is registered under, its
    fields are its options, in Python, in text and in files alike. It is imported when
    it is asked for. An entry that cannot be used is an error only where it is asked
    for; :func:`~me2e_compress.base.registry.describe` tells of it.

    Attributes:
        kind: what one entry is, in a word or two, for messages.
        group: entry-point group of other packages.
        error: what is raised.
        builtin: ours, name to ``module:Class``.
    """

    kind: str
    group: str
    error: type[Me2eError]
    builtin: Mapping[str, str]

    def names(self) -> tuple[str, ...]:
        """List the names: ours in their order, then others by the alphabet."""
        others = {entry.name for entry in _entry_points(self.group)}
        return (*self.builtin, *sorted(others - set(self.builtin)))

    def get(self, name: str) -> type[T]:
        """Import the class of a name.

        What does not load, is not of the right form or is claimed by two packages is an
        ``error``; a missing package of an extra is a MissingExtraError.
        """
        claim, *rivals = self._entries(name) or (None,)
        if claim is None:
            raise self._unknown_name(name)
        if rivals:
            packages = " and ".join(self.sources(name))
            raise self.error(
                f"{self.kind} {name!r} is claimed by {packages}: uninstall one of them"
            )
        return self._load(claim)

    def usable(self) -> tuple[str, ...]:
        """List the names whose classes can be imported."""
        usable = list[str]()
        for name in self.names():
            with contextlib.suppress(Me2eError):
                self.get(name)
                usable.append(name)
        return tuple(usable)

    def build(self, name: str, options: Mapping[str, object]) -> T:
        """Make an item from options, each checked by its field's type."""
        return self.make(self.get(name), options)

    def make(self, cls: type[T], options: Mapping[str, object]) -> T:
        """Make an item of a class that need not be registered; see :meth:`build`."""
        name, known = cls.name, [field.name for field in fields_of(cls)]
        if unknown := [option for option in options if option not in known]:
            there = ", ".join(known) or "none"
            raise self.error(f"{name} has no option {unknown[0]!r}; it has {there}")
        # pydantic checks every option by the type of its field
        try:
            made: T = _adapter(cls).validate_python(dict(options))
        except pydantic.ValidationError as error:
            first = error.errors(include_url=False)[0]
            location = ".".join(str(part) for part in first["loc"]) or "options"
            if first["type"] == "missing":
                raise self.error(f"{name} needs the option {location}") from error
            if own := first.get("ctx", {}).get("error"):  # the item's own words
                raise self.error(with_prefix(name, str(own))) from error
            text = first["msg"].replace("a valid tuple", "a list, as [a, b]")
            raise self.error(f"{name}: {location}: {text}") from error
        return made

    def with_options(self, item: T, options: Mapping[str, object]) -> T:
        """Make an item like another, with other options; see :meth:`build`."""
        names = [field.name for field in fields_of(type(item))]
        values = {name: getattr(item, name) for name in names}
        return self.make(type(item), {**values, **options})

    def parse(
        self,
        text: str,
        cls: type[T] | None = None,
        more: Mapping[str, object] | None = None,
    ) -> T:
        """Make an item from ``name``, ``name{option=value, ...}`` or ``name:value``.

        ``cls`` need not be registered; None finds the class by the name. The text must
        not give the options in ``more``. Anything else is an ``error``.
        """
        try:
            item = read_one(text)
        except TextError as error:
            if not name_in(text):
                raise self._unknown_name(text) from error
            raise self.error(f"{self.kind}: {error}") from error
        # The name decides the class, unless the caller knows it
        return self._build(item, cls or self.get(item.name), more)

    def parse_all(self, text: str) -> tuple[T, ...]:
        """Make the items that a text lists, parted by commas; see :meth:`parse`."""
        try:
            items = read_all(text)
        except TextError as error:
            raise self.error(f"{self.kind}: {error}") from error
        return tuple(self._build(item, self.get(item.name)) for item in items)

    def text(self, item: T, *, defaults: bool = False) -> str:
        """Write an item so that :meth:`parse` makes an equal one.

        Options at their default are left out unless ``defaults``.
        """
        fields = [field for field in fields_of(type(item)) if field.name != "name"]
        values = {field.name: getattr(item, field.name) for field in fields}
        # Fields that hold functions have no text
        chosen = {
            field.name: values[field.name]
            for field in fields
            if not callable(values[field.name])
            and (
                defaults
                or field.metadata.get("written")
                or values[field.name] != default_of(field)
            )
        }
        return write_item(item.name, chosen, short=len(fields) == 1)

    def text_all(self, items: Iterable[T]) -> str:
        """Write items so that :meth:`parse_all` makes equal ones."""
        return ",".join(self.text(item) for item in items)

    def option_schema(self, base: type) -> CoreSchema:
        """Return pydantic's schema of an option that takes any item, or its text."""
        return core_schema.no_info_before_validator_function(
            lambda value: self.parse(value) if isinstance(value, str) else value,
            core_schema.is_instance_schema(base),
        )

    def sources(self, name: str) -> tuple[str, ...]:
        """Name the packages that bring a name, each with its version."""
        return tuple(_package_of(entry) for entry in self._entries(name))

    def _unknown_name(self, name: str) -> Me2eError:
        there = ", ".join(self.names()) or "none"
        return self.error(f"no {self.kind} {name!r}; there are {there}")

    def _build(
        self, item: ParsedItem, cls: type[T], more: Mapping[str, object] | None = None
    ) -> T:
        """Make an item of what was parsed; options in ``more`` must not be in it."""
        # a version is written as a number, and is a text
        texts = [field.name for field in fields_of(cls) if field.type is str]
        written = {name: text for name, text in item.numbers.items() if name in texts}
        options, more = {**item.options, **written}, more or {}
        if item.value is not None:
            first = next((field for field in fields_of(cls) if not field.kw_only), None)
            if first is None:
                raise self.error(f"{item.name} takes no value, found {item.value!r}")
            options = {first.name: item.value}
        if twice := [option for option in more if option in options]:
            raise self.error(f"{item.name}: option {twice[0]} is given twice")
        return self.make(cls, {**options, **more})

    def _entries(self, name: str) -> tuple[EntryPoint, ...]:
        """List what is to be loaded for a name; more than one is a conflict."""
        points = _entry_points(self.group)
        theirs = tuple(entry for entry in points if entry.name == name)
        if name not in self.builtin:
            return theirs
        return (EntryPoint(name, self.builtin[name], self.group), *theirs)

    def _load(self, entry: EntryPoint) -> type[T]:
        """Import an entry's class; raises as :meth:`get` does."""
        what = f"{self.kind} {entry.name!r} of {_package_of(entry)} ({entry.value})"
        try:
            cls = entry.load()
        except Me2eError:
            raise
        except Exception as error:  # whatever an import of theirs may raise: chained
            line = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise self.error(f"{what} cannot be imported: {line}") from error
        # A class that can be built, and is called as it is registered
        if not is_frozen_dataclass(cls):
            raise self.error(f"{what} is not a frozen dataclass")
        if inspect.isabstract(cls):
            lacks = ", ".join(sorted(cls.__abstractmethods__))
            raise self.error(f"{what} does not define {lacks}")
        if getattr(cls, "name", None) != entry.name:
            raise self.error(f"{what} calls itself {getattr(cls, 'name', None)!r}")
        built: type[T] = cls
        return built


def fields_of(cls: type) -> tuple["dataclasses.Field[Any]", ...]:
    """Return the fields of a dataclass that are its options, those by keyword last."""
    fields = [field for field in dataclasses.fields(cls) if field.init]
    return tuple(sorted(fields, key=lambda field: field.kw_only is True))


# Metadata of a field that a text names even at its default
IN_TEXT: Mapping[str, bool] = {"written": True}


def default_of(field: "dataclasses.Field[Any]") -> object:
    """Return the default of an option; MISSING where it must be given."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


@functools.cache
def _adapter(cls: type) -> "pydantic.TypeAdapter[Any]":
    return pydantic.TypeAdapter(cls)


def is_frozen_dataclass(cls: object) -> bool:
    """Return whether the class itself, not only a base, is a frozen dataclass."""
    if not isinstance(cls, type):
        return False
    parameters = vars(cls).get("__dataclass_params__")
    return parameters is not None and bool(parameters.frozen)


def _package_of(entry: EntryPoint) -> str:
    """Return the name of an entry point's package, with its version unless ours."""
    return _OURS if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"


def _entry_points(group: str) -> tuple[EntryPoint, ...]:
    return _all_entry_points(tuple(sys.path)).get(group, ())


@functools.cache
def _all_entry_points(path: tuple[str, ...]) -> Mapping[str, tuple[EntryPoint, ...]]:
    """Find the entry points along the path that modules are looked for on, by group."""
    points: Any = importlib.metadata.entry_points()  # a type of its own in Python 3.11
    return {group: tuple(points.select(group=group)) for group in points.groups}


# The entries of a registry, described: where from, and with which options.


# The module before a name, in a type
_PATH = re.compile(r"[A-Za-z_][\w.]*\.(?=[A-Za-z_])")
_SECTION = re.compile(r"\n(?:Attributes|Args):\n((?:[ \t]+.*\n?|\n)+)")
_OPTION = re.compile(r"^    (\w+): ((?:.|\n(?=      ))+)", re.MULTILINE)


@dataclasses.dataclass(frozen=True)
class Option:
    """One option of an entry; ``default`` is None where it must be given."""

    name: str
    type: str
    default: str | None
    doc: str


@dataclasses.dataclass(frozen=True)
class Entry:
    """One name of a registry.

    Attributes:
        name: as in recipes and commands.
        source: the package; with its version; of a name that several packages claim,
            all of them.
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
    entries = list[Entry]()
    for name in registry.names():
        source = " and ".join(registry.sources(name))
        try:
            cls = registry.get(name)
        except Me2eError as error:
            entries.append(Entry(name, source, error=str(error)))
            continue
        # What can be used is described by its docstring and fields
        first_line = (inspect.getdoc(cls) or "").partition("\n")[0]
        entries.append(Entry(name, source, first_line, options_of(cls)))
    return tuple(entries)


def options_of(cls: type) -> tuple[Option, ...]:
    """Describe the options of a dataclass, in the order of its fields."""
    docs, options = _option_docs(cls), list[Option]()
    for field in fields_of(cls):
        default, kind = default_of(field), field.type
        if not isinstance(kind, str):  # bounds of pydantic's are left out
            kind = inspect.formatannotation(get_type_hints(cls)[field.name])
        is_required = default is dataclasses.MISSING
        text = None if is_required else write_value(default)
        doc = docs.get(field.name, "")
        options.append(Option(field.name, _PATH.sub("", kind), text, doc))
    return tuple(options)


def _option_docs(cls: type) -> Mapping[str, str]:
    """Return what the section Attributes (or Args) says, by field; a base's, too."""
    docs = dict[str, str]()
    for base in reversed(cls.__mro__):
        section = _SECTION.search(inspect.cleandoc(base.__doc__ or "") + "\n")
        options = [] if section is None else _OPTION.findall(section.group(1))
        docs |= {name: " ".join(text.split()) for name, text in options}
    return docs
