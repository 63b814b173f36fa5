"""A pass as text: ``ablate-modules{drop=["occ"], fill="zeros"}``."""

import json
from collections.abc import Iterable

from me2e_compress.passes.base import Pass


def to_text(passes: Iterable[Pass]) -> str:
    """Write passes as a pipeline; options at their default are left out."""
    return ",".join(_one(current) for current in passes)


def _one(current: Pass) -> str:
    chosen = current.options()
    if not chosen:
        return current.name
    inner = ", ".join(f"{name}={_value(value)}" for name, value in chosen.items())
    return f"{current.name}{{{inner}}}"


def _value(value: object) -> str:
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, bool | int | float | str):
        return json.dumps(value)
    return json.dumps(str(value))
