"""Options compared by name, and the folder that belongs to some of them."""

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from me2e_compress.base.atomic import write_json
from models.driver.errors import TrainingError

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


def claim(manifest: Path, what: str, options: Mapping[str, Any]) -> None:
    """Make a folder that of some options, or check that it is.

    Args:
        manifest: the file in it that holds the options.
        what: they are of, in messages.
        options: as `dataclasses.asdict` gives them.

    Raises:
        TrainingError: it belongs to others, holds something else, or cannot be used.
    """
    folder = manifest.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not manifest.exists():
            if any(not file.name.startswith(".") for file in folder.iterdir()):
                raise TrainingError(
                    f"{folder}: not empty, and holds no {manifest.name}"
                )
            write_json(manifest, dict(options), indent=1)
        before = json.loads(manifest.read_bytes())
    except OSError as error:
        raise TrainingError(f"{folder}: cannot be used: {error.strerror}") from error
    except ValueError as error:
        raise TrainingError(f"{manifest}: not JSON") from error
    if not isinstance(before, dict):
        raise TrainingError(f"{manifest}: not a {what}")
    if (words := difference(before, options)) is not None:
        name, old, new = words
        raise TrainingError(
            f"{folder}: holds another {what}: its {name} is {old}, this one's {new}; "
            "choose another folder, or the same options"
        )
