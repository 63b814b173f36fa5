import re
from pathlib import Path

import pytest

import me2e_compress
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.manager import recipe
from me2e_compress.passes import PASSES

DOCS = Path(__file__).parents[1] / "docs"


@pytest.mark.parametrize("name", me2e_compress.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(me2e_compress, name) is not None


def test_completion_offers_every_public_name_and_room() -> None:
    offered = dir(me2e_compress)

    assert set(me2e_compress.__all__) <= set(offered)
    assert {"passes", "errors", "testing", "__doc__", "__file__"} <= set(offered)
    assert all(getattr(me2e_compress, name) is not None for name in offered if name)


@pytest.mark.parametrize("name", PASSES.names())
def test_every_pass_shows_before_and_after(name: str) -> None:
    text = PASSES.get(name).__doc__ or ""
    assert "Given:" in text
    assert "Result:" in text


@pytest.mark.parametrize("name", PASSES.names())
def test_every_pass_is_documented(name: str) -> None:
    assert f"`{name}`" in (DOCS / "passes.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", recipe.shipped())
def test_every_recipe_is_documented(name: str) -> None:
    assert f"`{name}`" in (DOCS / "recipes.md").read_text(encoding="utf-8")


def test_the_links_of_the_documents_lead_somewhere() -> None:
    for page in (DOCS.parent / "README.md", *sorted(DOCS.glob("*.md"))):
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_map_of_the_documents_is_a_map() -> None:
    text = (DOCS / "modules.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    assert ModuleMap.parse(block, "documents").names() == ("backbone", "map")


def test_the_pipeline_of_the_recipes_parses() -> None:
    text = (DOCS / "recipes.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"--passes '([^']+)'", text)
    assert [current.name for current in recipe.parse(line)][1] == "ablate-modules"
