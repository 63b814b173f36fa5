"""Options compared by name."""

import json
from collections.abc import Collection, Mapping
from typing import Any

Words = tuple[str, str, str]


def difference(
    before: Mapping[str, Any], now: Mapping[str, Any], but: Collection[str] = ()
) -> Words | None:
    """Return the first option that differs: (dotted name, before, now).

    An option that one side does not know is another value, too.

    Args:
        before: options as JSON told them.
        now: options; tuples count as lists.
        but: names that do not matter.
    """
    old, new = _flat(before), _flat(json.loads(json.dumps(now)))
    for name in sorted({*old, *new}):
        found, wanted = old.get(name, "missing"), new.get(name, "missing")
        if found != wanted and name not in but:
            return name, found, wanted
    return None


def _flat(options: Mapping[str, Any]) -> dict[str, str]:
    """Flatten options within options, and lists of them, to JSON by dotted name."""
    flat = dict[str, str]()
    for name, value in options.items():
        inner = value
        if isinstance(value, list) and value and isinstance(value[0], dict):
            flat[f"{name}.length"] = str(len(value))
            inner = {str(number): each for number, each in enumerate(value)}
        if isinstance(inner, dict):
            flat |= {f"{name}.{key}": one for key, one in _flat(inner).items()}
        else:
            flat[name] = json.dumps(value)
    return flat
