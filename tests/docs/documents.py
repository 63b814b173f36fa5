"""What docs/json.md says of the documents that ``--json`` prints."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from tests.docs.pages import ROOT

PAGE = ROOT / "docs" / "json.md"
EVERY, OBJECTS = "Every document", "Objects"

_SECTION = re.compile(r"^## `?(.+?)`?$", re.MULTILINE)
_FIELD = re.compile(r"^`([^`]+?): ([^`]+)`", re.MULTILINE)
_TOKEN = re.compile(r"[\[\]{},:?]|[^\[\]{},:?\s]+")
_ATOMS: Mapping[str, tuple[type, ...]] = {
    "string": (str,),
    "boolean": (bool,),
    "integer": (int,),
    "number": (int, float),
    "object": (dict,),
}


@dataclass(frozen=True)
class Kind:
    """What a value may be.

    Attributes:
        names: of atoms or objects; one of them.
        array: of its elements, if it may be an array.
        fields: by key, if it may be an object; ``*`` stands for all other keys.
    """

    names: tuple[str, ...] = ()
    null: bool = False
    array: "Kind | None" = None
    fields: "Mapping[str, Kind] | None" = None


Fields = Mapping[str, Kind]


@cache
def sections() -> dict[str, tuple[Fields, ...]]:
    """Read the tables of every command; a command may print documents of two forms."""
    _, *parts = _SECTION.split(PAGE.read_text(encoding="utf-8"))
    tables = dict(zip(parts[::2], parts[1::2], strict=True))
    del tables[OBJECTS]
    return {name: tuple(_tables(text)) for name, text in tables.items()}


@cache
def _objects() -> Mapping[str, Fields]:
    """Read the objects: the name of one stands before its first key of a row."""
    text = PAGE.read_text(encoding="utf-8").partition(f"## {OBJECTS}")[2]
    found = dict[str, dict[str, Kind]]()
    for keys, kind in _FIELD.findall(text):
        name, _, keys = keys.partition(".")
        found.setdefault(name, {}).update(_read(f"{{{keys}: {kind}}}").fields or {})
    return found


def _tables(text: str) -> Iterator[Fields]:
    for block in text.split("\n\n"):
        rows = [f"{keys}: {kind}" for keys, kind in _FIELD.findall(block)]
        if rows:
            yield _read("{" + ", ".join(rows) + "}").fields or {}


def _read(text: str) -> Kind:
    """Read a type as the page writes it."""
    tokens = _TOKEN.findall(text)
    kind = _kind(tokens)
    assert not tokens, text
    return kind


def _kind(tokens: list[str]) -> Kind:
    first = tokens.pop(0)
    names: tuple[str, ...] = ()
    array = fields = None
    if first == "[":
        array = _kind(tokens)
        assert tokens.pop(0) == "]"
    elif first == "{":
        fields = _fields(tokens)
    else:
        names = (first,)
    null = bool(tokens) and tokens[0] == "?" and bool(tokens.pop(0))
    if tokens and tokens[0] == "or":
        del tokens[0]
        other = _kind(tokens)
        names, null = (*names, *other.names), null or other.null
        array, fields = array or other.array, fields or other.fields
    return Kind(names, null, array, fields)


def _fields(tokens: list[str]) -> Fields:
    """Read ``a, b: T, c?: T}``, or ``T}`` of any keys."""
    named = tokens[: tokens.index("}")]
    if ":" not in named or "{" in named[: named.index(":")]:
        others = _kind(tokens)
        assert tokens.pop(0) == "}"
        return {"*": others}
    found, keys = dict[str, Kind](), list[str]()
    while (token := tokens.pop(0)) != "}":
        if token == "?":
            keys[-1] += "?"
        elif token == ":":
            kind = _kind(tokens)
            found |= dict.fromkeys(keys, kind)
            keys = []
        elif token != ",":
            keys.append(token)
    return found


def faults(command: str, document: Any) -> list[str]:
    """Say how a document differs from the page; of several forms the nearest counts."""
    (every,) = sections()[EVERY]
    forms = ({**every, **_spread(form)} for form in sections()[command])
    return min((list(_differ(document, form, "")) for form in forms), key=len)


def _spread(fields: Fields) -> Fields:
    """Put the keys of another object in the place of ``+``."""
    base = fields.get("+")
    if base is None:
        return fields
    own = {key: kind for key, kind in fields.items() if key != "+"}
    return {**_named(*base.names), **own}


def _named(name: str) -> Fields:
    """Find an object, or what a command prints."""
    return _spread(sections()[name][0] if name in sections() else _objects()[name])


def _differ(value: Mapping[str, Any], fields: Fields, path: str) -> Iterator[str]:
    """Yield what is missing, is not on the page, or of another type."""
    known = {key.removesuffix("?"): kind for key, kind in fields.items()}
    for key in fields:
        if not key.endswith("?") and key not in value and key != "*":
            yield f"{path}{key} is missing"
    for key, each in value.items():
        kind = known.get(key, known.get("*"))
        if kind is None:
            yield f"{path}{key} is not documented"
        else:
            yield from _wrong(each, kind, f"{path}{key}")


def _wrong(value: Any, kind: Kind, path: str) -> Iterator[str]:
    """Yield how a value differs from its type."""
    if value is None and kind.null:
        return
    if any(type(value) in _ATOMS.get(name, ()) for name in kind.names):
        return
    objects = [name for name in kind.names if name not in _ATOMS]
    if isinstance(value, list) and kind.array is not None:
        for each in value:
            yield from _wrong(each, kind.array, f"{path}[]")
    elif isinstance(value, dict) and (objects or kind.fields is not None):
        fields = _named(*objects) if objects else _spread(kind.fields or {})
        yield from _differ(value, fields, f"{path}.")
    else:
        yield f"{path} is a {type(value).__name__}"
