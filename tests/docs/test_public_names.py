"""The public names are those of ``public_names.txt``: none comes or goes unseen.

After a change that is meant: ``python -m tests.docs.test_public_names``.
"""

import importlib
import inspect
import re
from enum import Enum
from pathlib import Path
from types import ModuleType

import pytest

import me2e_compress
from me2e_compress.cli.app import COMMANDS
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import recipe
from me2e_compress.passes import PASSES
from tests.docs.pages import PAGES, ROOT, blocks

DOCS = ROOT / "docs"
LIST = Path(__file__).with_name("public_names.txt")
LINES = LIST.read_text(encoding="utf-8").splitlines()
ROOMS = tuple(dict.fromkeys(line.partition(": ")[0] for line in LINES))


def public_names(module: ModuleType) -> list[str]:
    """List what a room names in ``__all__``, or else has without an underscore."""
    names = [name for name in vars(module) if not name.startswith("_")]
    plain = [name for name in names if not inspect.ismodule(getattr(module, name))]
    return sorted(getattr(module, "__all__", plain))


@pytest.mark.parametrize("room", ROOMS)
def test_the_public_names_of_a_room_are_those_of_the_list(room: str) -> None:
    module = importlib.import_module(room)
    names = public_names(module)
    assert [f"{room}: {name}" for name in names] == [
        line for line in LINES if line.startswith(f"{room}: ")
    ]
    # they are there, and no signature shows an address
    objects = [getattr(module, name) for name in names]
    shown = [
        str(inspect.signature(each))
        for each in objects
        if inspect.isroutine(each)
        or (inspect.isclass(each) and not issubclass(each, Enum | Exception))
    ]
    assert [text for text in shown if " at 0x" in text] == []


def test_completion_offers_every_public_name_and_room() -> None:
    offered = dir(me2e_compress)

    assert set(vars(me2e_compress)["__all__"]) <= set(offered)
    assert {"passes", "base", "testing", "__doc__", "__file__"} <= set(offered)
    assert all(getattr(me2e_compress, name) is not None for name in offered if name)


def test_a_name_that_is_none_is_an_error() -> None:
    """And one for mypy, which would call the comment unused (``make check``)."""
    with pytest.raises(AttributeError, match="me2e_compress has no nothing"):
        _ = me2e_compress.nothing  # type: ignore[attr-defined]


def test_the_package_page_tells_the_function_of_every_command() -> None:
    page = (DOCS / "package.md").read_text(encoding="utf-8")
    (line,) = (line for line in page.splitlines() if line.startswith("In Python "))
    functions, others = line.split(" are commands alone")[0].rsplit(". ", 1)
    names = set(re.findall(r"`(\w+)`", functions))
    without = set(re.findall(r"`(\w+)`", others))

    assert {*names, *without} >= COMMANDS.keys()
    assert names - {"frames", "sensitivity", "study"} <= set(
        vars(me2e_compress)["__all__"]
    )
    assert not without & set(vars(me2e_compress)["__all__"])


@pytest.mark.parametrize("name", PASSES.names())
def test_every_pass_is_documented_and_shows_before_and_after(name: str) -> None:
    text = PASSES.get(name).__doc__ or ""
    assert "Given:" in text
    assert "Result:" in text
    assert f"`{name}`" in (DOCS / "passes.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", recipe.shipped())
def test_every_recipe_is_documented(name: str) -> None:
    assert f"`{name}`" in (DOCS / "recipes.md").read_text(encoding="utf-8")


def test_the_map_and_the_pipeline_of_the_documents_parse() -> None:
    (block,) = blocks(DOCS / "modules.md", "toml")
    assert ModuleMap.parse(block.text, "documents").names() == ("backbone", "map")
    text = (DOCS / "recipes.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"--passes '([^']+)'", text)
    assert [current.name for current in recipe.parse(line)][1] == "ablate-modules"


def test_the_links_of_the_documents_lead_somewhere_and_to_every_page() -> None:
    linked = set[str]()
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
            linked |= {target} if page == DOCS / "README.md" else set()
    pages = {page.name for page in DOCS.glob("*.md")}
    assert pages - linked == {"README.md", "package.md"}  # the latter is the wheel's


if __name__ == "__main__":
    names = {room: public_names(importlib.import_module(room)) for room in ROOMS}
    lines = [f"{room}: {name}\n" for room, listed in names.items() for name in listed]
    LIST.write_text("".join(lines), encoding="utf-8")
