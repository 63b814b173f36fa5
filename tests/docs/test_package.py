"""What the index shows, what the wheel holds, what a source distribution needs."""

import re
import tomllib
from pathlib import Path

import pytest

from me2e_compress.shipped.drivers import SHIPPED
from tests.docs.pages import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
MOST_BYTES = 15_000_000
"""Of the wheel: two drivers of 6.7 MB are most of it."""


def test_the_page_of_the_index_needs_no_checkout() -> None:
    text = (ROOT / PROJECT["readme"]).read_text(encoding="utf-8")

    links = re.findall(r"\]\(([^)]+)\)|<img[^>]+src=\"([^\"]+)", text)
    assert [link for link in links if not link[0].startswith("https://")] == []


def test_the_project_says_who_and_for_whom() -> None:
    assert PROJECT["authors"] == [{"name": PROJECT["name"]}]
    assert "Typing :: Typed" in PROJECT["classifiers"]
    assert "urls" not in PROJECT, "a URL must lead somewhere: try it, then name it here"


@pytest.mark.xdist_group("installed")
def test_the_wheel_is_small_and_brings_the_driver(site: Path) -> None:
    weights = {file.name for file in (site / "me2e_compress/shipped/weights").iterdir()}
    forms = (".json", ".onnx", "-frames")
    assert weights == {f"{name}{form}" for name in SHIPPED for form in forms}
    (wheel,) = site.parent.glob("wheels[0-9]*/me2e_compress-*.whl")
    assert wheel.stat().st_size < MOST_BYTES


@pytest.mark.parametrize(
    "needed", ["Makefile", "constraints.txt", "README.md", "docs", "tests", "examples"]
)
def test_a_source_distribution_takes_what_make_needs(needed: str) -> None:
    listed = (ROOT / "MANIFEST.in").read_text(encoding="utf-8").split()

    assert needed in listed
    assert (ROOT / needed).exists()
