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
from collections.abc import Iterable
from importlib import resources
from pathlib import Path

from me2e_compress.base import documents
from me2e_compress.base.errors import RecipeError
from me2e_compress.passes import PASSES, Pass

__all__ = ["load", "parse", "shipped", "to_text"]


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
    path, base = Path(name), Path()
    try:
        if path.is_file():
            content, base = documents.read_bytes(path), path.parent
        elif str(name) in shipped():
            folder = resources.files("me2e_compress") / "recipes"
            content = (folder / f"{name}.toml").read_bytes()
        else:
            raise RecipeError(
                f"no recipe {name}: no such file; we ship {', '.join(shipped())}"
            )
        tables = documents.from_toml(content)
    except documents.MalformedError as error:
        raise RecipeError(f"{name} is not TOML: {error}") from error
    entries = tables.get("pass")
    listed = entries if isinstance(entries, list) else []
    if not listed or not all(isinstance(entry, dict) for entry in listed):
        raise RecipeError(f"{name} has no [[pass]]")
    if beside_them := [key for key in tables if key != "pass"]:
        raise RecipeError(
            f"{name}: {beside_them[0]!r} stands beside [[pass]], where nothing is read;"
            " options stand below the [[pass]] that they are of"
        )
    built: list[Pass] = []
    for entry in listed:
        options = dict(entry)
        current = PASSES.build(str(options.pop("name", "")), options)
        # Files that it names are in the folder of its recipe
        files = {
            field.name: base / value
            for field in dataclasses.fields(current)
            if isinstance(value := getattr(current, field.name), Path)
        }
        built.append(dataclasses.replace(current, **files))
    return tuple(built)


def parse(text: str) -> tuple[Pass, ...]:
    """Build the passes that a line of text lists.

    Raises:
        RecipeError: the text is not a pipeline, or names an unknown pass or option.
    """
    return PASSES.parse_all(text)


def to_text(passes: Iterable[Pass]) -> str:
    """Write passes as a pipeline; options at their default are left out."""
    return PASSES.text_all(passes)
