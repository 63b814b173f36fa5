"""What docs/json.md says of the documents that ``--json`` prints."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from tests.docs.pages import ROOT

PAGE = ROOT / "docs" / "json.md"
EVERY = "Every document"

_SECTION = re.compile(r"^## `?(.+?)`?$", re.MULTILINE)
_ROW = re.compile(r"^\| `(\S+)` \| ([a-z ]+) \|.*\|$")
_KINDS: Mapping[type, str] = {
    dict: "object",
    list: "array",
    str: "string",
    bool: "boolean",
    int: "integer",
    float: "number",
    type(None): "null",
}

Keys = Mapping[str, frozenset[str]]
"""Types by the path of a key."""


def sections() -> dict[str, tuple[Keys, ...]]:
    """Read the tables of every command; a command may print documents of two forms."""
    _, *parts = _SECTION.split(PAGE.read_text(encoding="utf-8"))
    names, texts = parts[::2], parts[1::2]
    return {n: tuple(_tables(t)) for n, t in zip(names, texts, strict=True)}


def _tables(text: str) -> Iterator[Keys]:
    for block in text.split("\n\n"):
        rows = {row[1]: row[2] for row in map(_ROW.match, block.splitlines()) if row}
        if rows:
            yield {key: frozenset(each.split(" or ")) for key, each in rows.items()}


def faults(command: str, document: Any) -> list[str]:
    """Say how a document differs from the page; of several forms the nearest counts."""
    known = sections()
    (every,) = known[EVERY]
    forms = ({**every, **form} for form in known[command])
    return min((list(_faults(document, form)) for form in forms), key=len)


def _faults(document: Any, keys: Keys) -> Iterator[str]:
    found: dict[str, set[str]] = {}
    _walk(document, "", keys, found)
    for path in keys:
        parent, _, last = path.rpartition(".")
        expected = not parent or "object" in found.get(parent, ())
        if expected and path not in found and last != "*" and not last.endswith("[]"):
            yield f"{path} is missing"
    for path, kinds in found.items():
        allowed = keys.get(path) or _either(path, keys)
        if allowed is None:
            if _is_closed(path, keys):
                yield f"{path} is not documented"
        elif odd := {k for k in kinds if k not in allowed and not _fits(k, allowed)}:
            yield f"{path} is {sorted(odd)}, not {sorted(allowed)}"


def _walk(value: Any, path: str, keys: Keys, found: dict[str, set[str]]) -> None:
    if path:
        found.setdefault(path, set()).add(_KINDS[type(value)])
    if isinstance(value, Mapping):
        for key, each in value.items():
            prefix = f"{path}." if path else ""
            named = f"{prefix}{key}"
            known = named in keys or f"{prefix}*" not in keys
            _walk(each, named if known else f"{prefix}*", keys, found)
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for each in value:
            _walk(each, f"{path}[]", keys, found)


def _either(path: str, keys: Keys) -> frozenset[str] | None:
    """Find the types of what stands in an array whose elements are objects."""
    if path.endswith("[]") and any(key.startswith(f"{path}.") for key in keys):
        return frozenset({"object"})
    return None


def _is_closed(path: str, keys: Keys) -> bool:
    """Tell whether the page names all keys of the object that a path is of."""
    parent = path.rpartition(".")[0]
    siblings = (key.rpartition(".")[0] for key in keys)
    return not path.endswith("[]") and parent in siblings


def _fits(kind: str, allowed: frozenset[str]) -> bool:
    return kind == "integer" and "number" in allowed
