"""What the documents say of writing additions is done to an installed package."""

import dataclasses
import importlib
import re
import sys
import tomllib
from pathlib import Path

import pytest

from me2e_compress.registry import Registry
from me2e_compress.testing import check_form
from me2e_compress.workflows import listing
from tests.docs.conftest import run
from tests.docs.pages import EXAMPLE, ROOT, WRITING, blocks

pytestmark = pytest.mark.xdist_group("installed")
EXAMPLE_PROJECT = (EXAMPLE / "pyproject.toml").read_text(encoding="utf-8")
pages = pytest.mark.parametrize("page", WRITING, ids=lambda page: page.stem)


def entry_points(text: str) -> dict[str, dict[str, str]]:
    """Read the additions that a project file names, by group."""
    found: dict[str, dict[str, str]] = tomllib.loads(text)["project"]["entry-points"]
    return found


@pages
def test_the_code_of_a_page_runs(page: Path, folder: Path, site: Path) -> None:
    script = folder / "page.py"
    script.write_text("".join(block.text for block in blocks(page, "python")))
    run([sys.executable, "-W", "error", str(script)], folder, site)


@pages
def test_the_commands_of_a_page_run(page: Path, folder: Path, site: Path) -> None:
    for block in blocks(page, "sh"):
        assert run(["bash", "-e", "-c", block.text], folder, site)


@pages
def test_the_example_package_is_what_the_page_shows_or_names(page: Path) -> None:
    shown = [block for block in blocks(page, "python") if block.file]
    named = re.findall(r"\.\./(examples/third_party/\w+/\w+\.py)", page.read_text())
    assert shown or named
    assert all((ROOT / each).is_file() for each in named)
    for block in shown:
        source = EXAMPLE / str(block.file)
        assert block.body == source.read_text(encoding="utf-8")


@pages
def test_the_entry_points_of_a_page_are_those_of_the_example(page: Path) -> None:
    example = tomllib.loads((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))
    for block in blocks(page, "toml"):
        for group, shown in tomllib.loads(block.text)["project"][
            "entry-points"
        ].items():
            assert shown == example["project"]["entry-points"][group]


def test_every_addition_of_the_example_is_listed(folder: Path, site: Path) -> None:
    listed = run(["me2e-compress", "list"], folder, site)
    for names in entry_points(EXAMPLE_PROJECT).values():
        for name in names:
            assert re.search(rf"\b{name}\b", listed), name


@pytest.mark.parametrize(
    ("group", "where"),
    [
        (group, where)
        for group, names in entry_points(EXAMPLE_PROJECT).items()
        for where in names.values()
    ],
)
def test_every_addition_of_the_example_has_the_form_of_ours(
    group: str, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    module, _, name = where.partition(":")
    added = getattr(importlib.import_module(module), name)
    needed = {
        each.name: Path("rides")
        for each in dataclasses.fields(added)
        if each.default is dataclasses.MISSING
        and each.default_factory is dataclasses.MISSING
    }
    (registry,) = (
        each
        for each in vars(listing).values()
        if isinstance(each, Registry) and each.group == group
    )
    check_form(added(**needed), registry)
