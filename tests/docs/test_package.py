"""What the README shows and prints, what the wheel and a source distribution hold."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from me2e_compress.shipped.drivers import SHIPPED
from tests.docs.pages import ROOT, blocks
from tests.support.command import Cli

README = ROOT / "README.md"
MOST_BYTES = 15_000_000
"""Of the wheel: two drivers of 6.7 MB are most of it."""


def test_the_page_of_the_index_needs_no_checkout() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    text = (ROOT / project["readme"]).read_text(encoding="utf-8")

    links = re.findall(r"\]\(([^)]+)\)|<img[^>]+src=\"([^\"]+)", text)
    assert [link for link in links if not link[0].startswith("https://")] == []


@pytest.mark.xdist_group("installed")
def test_the_wheel_is_small_and_brings_the_driver(site: Path) -> None:
    weights = {file.name for file in (site / "me2e_compress/shipped/weights").iterdir()}
    forms = (".json", ".onnx", "-frames")
    assert weights == {f"{name}{form}" for name in SHIPPED for form in forms}
    (wheel,) = site.parent.glob("wheels[0-9]*/me2e_compress-*.whl")
    assert wheel.stat().st_size < MOST_BYTES


def test_a_source_distribution_takes_what_make_needs() -> None:
    listed = set((ROOT / "MANIFEST.in").read_text(encoding="utf-8").split())
    needed = {"Makefile", "constraints.txt", "README.md", "docs", "tests", "examples"}
    assert needed <= listed
    assert all((ROOT / name).exists() for name in needed)


def test_the_readme_is_read_in_five_minutes() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.split()) <= 700
    assert len(text.splitlines()) <= 100


@pytest.mark.slow
def test_the_six_commands_run_and_print_what_the_readme_says(cli: Cli) -> None:
    (block,) = blocks(README, "console")
    _, *six = block.text.split("$ me2e-compress ")
    assert len(six) == 6
    for line, *printed in map(str.splitlines, six):
        name, *words = shlex.split(line)
        shown = _without_figures(cli.done(name, *words).out)
        assert [p for p in printed if _without_figures(p) not in shown] == []


def _without_figures(text: str) -> str:
    """Leave out what differs from machine to machine, and where lines are broken."""
    return " ".join(re.sub(r"[\d.,]+", "#", text).split())
