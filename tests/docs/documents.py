"""What docs/json.md says of the documents that ``--json`` prints."""

import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from tests.docs.pages import ROOT

PAGE = ROOT / "docs" / "json.md"
EVERY, OBJECTS = "Every document", "Objects"

_SECTION = re.compile(r"^## `?(.+?)`?$", re.MULTILINE)
_FIELD = re.compile(r"^`([^`]+)`", re.MULTILINE)
_ATOMS: Mapping[str, tuple[type, ...]] = {
    "string": (str,),
    "boolean": (bool,),
    "integer": (int,),
    "number": (int, float),
    "object": (dict,),
}

Fields = Mapping[str, str]
"""Types by key; ``*`` stands for all other keys, ``+`` for those of another object."""


@cache
def sections() -> dict[str, tuple[Fields, ...]]:
    """Read the tables of every command; a command may print documents of two forms."""
    _, *parts = _SECTION.split(PAGE.read_text(encoding="utf-8"))
    texts = dict(zip(parts[::2], parts[1::2], strict=True))
    tables = {
        name: map(_FIELD.findall, text.split("\n\n")) for name, text in texts.items()
    }
    return {
        name: tuple(_fields(", ".join(rows)) for rows in found if rows)
        for name, found in tables.items()
        if name != OBJECTS
    }


@cache
def _objects() -> Mapping[str, Fields]:
    """Read the objects: the name of one stands before the first key of a row."""
    text = PAGE.read_text(encoding="utf-8").partition(f"## {OBJECTS}")[2]
    found = dict[str, dict[str, str]]()
    for row in _FIELD.findall(text):
        name, _, fields = row.partition(".")
        found.setdefault(name, {}).update(_fields(fields))
    return found


def _fields(text: str) -> dict[str, str]:
    """Read ``a, b: T, c?: U``, or ``T`` of any keys."""
    if text[0] in "[{" or ": " not in text:
        return {"*": text}
    found, keys = dict[str, str](), list[str]()
    for part in _split(text, ", "):
        key, _, kind = part.partition(": ")
        keys.append(key)
        if kind:
            found |= dict.fromkeys(keys, kind)
            keys = []
    return found


def _split(text: str, at: str) -> list[str]:
    """Split a text outside of its brackets."""
    parts, depth = [""], 0
    for each in re.split(rf"([\[{{]|[\]}}]|{at})", text):
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(each, 0)
        if each == at and not depth:
            parts.append("")
        else:
            parts[-1] += each
    return parts


def faults(command: str, document: Any) -> list[str]:
    """Say how a document differs from the page; of several forms the nearest counts."""
    (every,) = sections()[EVERY]
    forms = ({**every, **_spread(form)} for form in sections()[command])
    return min((list(_differ(document, form, "")) for form in forms), key=len)


def _spread(fields: Fields) -> Fields:
    """Put the keys of another object in the place of ``+``."""
    return {**(_named(fields["+"]) if "+" in fields else {}), **fields}


def _named(name: str) -> Fields:
    """Find an object, or what a command prints."""
    return _spread(sections()[name][0] if name in sections() else _objects()[name])


def _differ(value: Mapping[str, Any], fields: Fields, path: str) -> Iterator[str]:
    """Yield what is missing, is not on the page, or of another type."""
    for key in fields:
        if not key.endswith("?") and key not in (*value, "*", "+"):
            yield f"{path}{key} is missing"
    for key, each in value.items():
        kind = fields.get(key, fields.get(f"{key}?", fields.get("*")))
        if kind is None:
            yield f"{path}{key} is not documented"
        else:
            yield from _wrong(each, kind, f"{path}{key}")


def _wrong(value: Any, kind: str, path: str) -> Iterator[str]:
    """Yield how a value differs from its type."""
    if value is None and kind.endswith("?"):
        return
    kinds = _split(kind.removesuffix("?"), " or ")
    if any(type(value) in _ATOMS.get(each, ()) for each in kinds):
        return
    others = {each[0]: each for each in kinds if each not in _ATOMS}
    if isinstance(value, list) and "[" in others:
        for each in value:
            yield from _wrong(each, others["["][1:-1], f"{path}[]")
    elif isinstance(value, dict) and (others.keys() - {"["}):
        (of,) = (each for first, each in others.items() if first != "[")
        fields = _spread(_fields(of[1:-1])) if of[0] == "{" else _named(of)
        yield from _differ(value, fields, f"{path}.")
    else:
        yield f"{path} is a {type(value).__name__}"
