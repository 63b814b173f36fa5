"""Recipes: passes in order, from a TOML file or from a line of text.

TOML::

    [[pass]]
    name = "ablate-modules"
    drop = ["occ"]

Text, the same: ``ablate-modules{drop=[occ]}``; passes are parted by commas. Words
inside the braces need no quotes. An option is a field of the pass's dataclass, in
Python, in a recipe and in text alike. A file that a recipe names is relative to the
folder of the recipe, one in a text to where you are.
"""

import dataclasses
import importlib.metadata
import re
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

import pydantic

from me2e_compress.errors import RecipeError
from me2e_compress.passes import PASSES, Pass
from me2e_compress.passes.spec import to_text

__all__ = ["build", "load", "parse", "registry", "shipped", "to_text"]

_PASS = re.compile(r"\s*([A-Za-z][\w.-]*)\s*(\{[^{}]*\})?\s*(,|$)")
_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|[^\s\[\]{},="]+(?P<key>\s*=)?')
_LITERAL = re.compile(r"true|false|[+-]?\d[\d_]*(\.\d+)?([eE][+-]?\d+)?")


@cache
def registry() -> Mapping[str, type[Pass]]:
    """Name every pass: ours, then those of the entry points ``me2e_compress.passes``.

    Raises:
        RecipeError: an entry point does not load, or takes a name that is taken.
    """
    found = dict(PASSES)
    for entry in importlib.metadata.entry_points(group="me2e_compress.passes"):
        try:
            cls = entry.load()
        except (ImportError, AttributeError) as error:
            raise RecipeError(f"pass {entry.name} of {entry.value}: {error}") from error
        if entry.name in found or getattr(cls, "name", None) != entry.name:
            raise RecipeError(
                f"entry point {entry.name} ({entry.value}): the name is taken, or is"
                f" not the pass's own ({getattr(cls, 'name', 'none')})"
            )
        found[entry.name] = cls
    return found


def shipped() -> list[str]:
    """Name the recipes that come with the package."""
    folder = resources.files("me2e_compress") / "recipes"
    return sorted(
        file.name.removesuffix(".toml")
        for file in folder.iterdir()
        if file.name.endswith(".toml")
    )


def load(name: str | Path) -> tuple[Pass, ...]:
    """Build the passes of a recipe file, or of a shipped recipe by its name.

    Raises:
        RecipeError: no such recipe, not TOML, or a pass or option nobody knows.
    """
    path, beside = Path(name), Path()
    source: Path | Traversable = path
    if path.is_file():
        beside = path.parent
    elif str(name) in shipped():
        source = resources.files("me2e_compress") / "recipes" / f"{name}.toml"
    else:
        raise RecipeError(
            f"no recipe {name}: no such file; we ship {', '.join(shipped())}"
        )
    try:
        content = tomllib.loads(source.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecipeError(f"{name} is not TOML: {error}") from error
    entries = content.get("pass")
    listed = entries if isinstance(entries, list) else []
    if not listed or not all(isinstance(entry, dict) for entry in listed):
        raise RecipeError(f"{name} has no [[pass]]")
    built: list[Pass] = []
    for entry in listed:
        options = dict(entry)
        built.append(_beside(build(str(options.pop("name", "")), options), beside))
    return tuple(built)


def parse(text: str) -> tuple[Pass, ...]:
    """Build the passes that a line of text lists.

    Raises:
        RecipeError: the text is not a pipeline, or names an unknown pass or option.
    """
    built: list[Pass] = []
    at = 0
    while at < len(text) or not built:
        match = _PASS.match(text, at)
        if match is None:
            raise RecipeError(f"not a pipeline from {text[at : at + 40]!r} on")
        name, body, _ = match.groups()
        built.append(build(name, _options(name, body or "{}")))
        at = match.end()
    return tuple(built)


def build(name: str, options: Mapping[str, object]) -> Pass:
    """Make one pass from its options, each checked against the field's type.

    Raises:
        RecipeError: no such pass, no such option, or a value of another type.
    """
    known = registry()
    if name not in known:
        raise RecipeError(f"no pass {name!r}; there are {', '.join(sorted(known))}")
    cls = known[name]
    fields = [f.name for f in dataclasses.fields(cls)]
    if unknown := [option for option in options if option not in fields]:
        raise RecipeError(
            f"{name} has no option {unknown[0]!r}; it has {', '.join(fields) or 'none'}"
        )
    try:
        made: Pass = pydantic.TypeAdapter(cls).validate_python(dict(options))
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "options"
        raise RecipeError(f"{name}: {where}: {first['msg']}") from error
    return made


def _beside(current: Pass, folder: Path) -> Pass:
    """Look for the files that a pass names in the folder of its recipe."""
    if not dataclasses.is_dataclass(current):
        return current
    files = {
        field.name: folder / value
        for field in dataclasses.fields(current)
        if isinstance(value := getattr(current, field.name), Path)
    }
    return dataclasses.replace(current, **files)


def _options(name: str, body: str) -> dict[str, object]:
    quoted = _TOKEN.sub(_quote, body)
    try:
        return dict(tomllib.loads(f"options = {quoted}")["options"])
    except tomllib.TOMLDecodeError as error:
        raise RecipeError(f"{name}: cannot read the options {body}: {error}") from error


def _quote(match: re.Match[str]) -> str:
    word = match.group()
    bare = match["key"] is None and not word.startswith('"')
    return f'"{word}"' if bare and _LITERAL.fullmatch(word) is None else word
