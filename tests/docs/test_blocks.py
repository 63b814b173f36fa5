"""Code, commands and TOML of the documents, run with installed packages."""

import contextlib
import dataclasses
import importlib
import json
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from me2e_compress.base.errors import GraphError
from me2e_compress.base.registry import Registry
from me2e_compress.cli.app import app
from me2e_compress.commands import listing
from me2e_compress.testing import check_form
from tests.docs.conftest import run, write_model
from tests.docs.pages import EXAMPLE, PAGES, ROOT, WRITING, Block, blocks
from tests.support.command import Cli
from tests.support.installed import install

pytestmark = pytest.mark.xdist_group("installed")
# the script of engine-dumps runs where an engine does; it has a test of its own
CODE = [p for p in PAGES if blocks(p, "python") and p.stem != "engine-dumps"]
README, *OTHERS = CODE

BEFORE = {
    "cameras": """
from me2e_compress.simulator.routes import load_routes
from me2e_compress.simulator.world import World
world = World(load_routes()[0])
""",
    "driver": f"""
import sys, types
sys.path.append({str(ROOT)!r})  # it is no part of the package
from models.driver import course
won = types.SimpleNamespace(driver="driver.onnx", scores=types.SimpleNamespace())
won.scores.driving_score = 0.0
course.run = lambda asked, folder, workers: (won,)  # days of work
""",
}
"""What a page takes for granted: a world to look at; not to train for days."""


def entry_points(text: str) -> dict[str, dict[str, str]]:
    """Read the additions that a project file names, by group."""
    found: dict[str, dict[str, str]] = tomllib.loads(text)["project"]["entry-points"]
    return found


ADDED = entry_points((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))
writing = pytest.mark.parametrize("page", WRITING, ids=lambda page: page.stem)


ALL_PAGES = """
import json, os, runpy, sys, traceback, warnings
errors = {}
for page in sys.argv[1:]:
    os.chdir(page)
    with warnings.catch_warnings():
        if "writing-" in page:
            warnings.simplefilter("error")
        try:
            runpy.run_path("page.py", run_name="__main__")
        except Exception:
            errors[os.path.basename(page)] = traceback.format_exc()
with open("../errors.json", "w") as stream:
    json.dump(errors, stream)
"""
"""Runs each in its folder; one process for all, which imports everything once."""


@pytest.fixture(scope="module")
def errors(site: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the code of pages raised, by page, the README left out."""
    pages = tmp_path_factory.mktemp("pages")
    folders = [write_page(page, pages / page.stem) for page in OTHERS]
    run([sys.executable, "-c", ALL_PAGES, *map(str, folders)], None, site)
    found: dict[str, str] = json.loads((pages / "errors.json").read_text())
    return found


def write_page(page: Path, folder: Path) -> Path:
    """Write its blocks, one behind the other, beside a model."""
    code = "".join(block.text for block in blocks(page, "python"))
    folder.mkdir(exist_ok=True)
    write_model(folder / "model.onnx")
    (folder / "page.py").write_text(BEFORE.get(page.stem, "") + code)
    return folder


@pytest.mark.parametrize("page", OTHERS, ids=lambda page: page.stem)
def test_the_code_of_a_page_runs(page: Path, errors: dict[str, str]) -> None:
    assert errors.get(page.stem) is None


def test_the_readme_proves_the_driver_that_ships_on_its_own_frames(
    tmp_path: Path, site: Path
) -> None:
    """Its planner tosses a coin on made-up inputs: the plan would go unjudged."""
    write_page(README, tmp_path)
    cells = "exec(open('page.py', encoding='utf-8').read())"  # has no main guard
    run([sys.executable, "-c", cells], tmp_path, site)

    report = json.loads((tmp_path / "highway.exact.report.json").read_text())
    (check,) = report["verifications"]
    assert check["inputs"] == "recorded"
    assert check["unsteady"] == []
    assert check["errors"]["plan"] < 1e-5
    assert check["errors"]["occupancy"] < 1e-5


OPERATORS = "me2e_compress.operators"
"""What a process looks for once: one of its own shows an example's."""
OTHER_PAGES = [page for page in WRITING if page.stem != "writing-operators"]


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The example package, installed as far as this process sees."""
    monkeypatch.syspath_prepend(EXAMPLE)
    for group in ADDED.keys() - {OPERATORS}:
        folder = tmp_path / "site"
        install(monkeypatch, folder, f"example-{group}", group, ADDED[group])


@pytest.mark.usefixtures("example", "short")
@pytest.mark.parametrize("page", OTHER_PAGES, ids=lambda page: page.stem)
def test_the_commands_of_a_page_run(page: Path, cli: Cli) -> None:
    write_model(cli.folder / "model.onnx")
    lines = [line for block in blocks(page, "sh") for line in block.text.splitlines()]
    for line in filter(None, lines):
        program, *words = shlex.split(line)
        assert program == "me2e-compress"
        assert cli.done(words[0], *words[1:]).out


def test_the_command_of_an_operator_runs(tmp_path: Path, site: Path) -> None:
    write_model(tmp_path / "model.onnx")
    (block,) = blocks(ROOT / "docs" / "writing-operators.md", "sh")
    assert run(["bash", "-e", "-c", block.text], tmp_path, site)


@pytest.mark.parametrize(
    "block",
    [block for page in PAGES for block in blocks(page, "toml")],
    ids=lambda block: block.text.splitlines()[0][:30],
)
def test_toml_is_toml(block: Block) -> None:
    assert tomllib.loads(block.text)


def commands() -> list[str]:
    """List every command line of the documents, continued lines joined."""
    found = []
    for page in PAGES:
        for block in blocks(page, "", "sh", "console"):
            text = block.text.replace("\\\n", " ")
            found += re.findall(r"^(?:\$ )?(me2e-compress .*)$", text, re.MULTILINE)
        found += re.findall(r"`(me2e-compress [^`]+)`", page.read_text("utf-8"))
    return list(dict.fromkeys(found))


@pytest.mark.parametrize("line", commands())
def test_a_command_of_the_documents_is_one(line: str) -> None:
    """Its options exist and its values are of their types; nothing is run."""
    words = shlex.split(re.split(r"\s{3,}", line)[0], comments=True)[1:]
    if len(words) > 1 and "..." not in line and "…" not in line:
        words = [each for each in words if each not in ("-q", "-v", "--json")]
        with contextlib.suppress(GraphError):  # the model is not there
            app.parse_args(words)


@writing
def test_the_example_package_is_what_the_page_shows_or_names(page: Path) -> None:
    shown = [block for block in blocks(page, "python") if block.file]
    named = re.findall(r"\.\./(examples/third_party/\w+/\w+\.py)", page.read_text())
    assert shown or named
    assert all((ROOT / each).is_file() for each in named)
    for block in shown:
        assert block.body == (EXAMPLE / str(block.file)).read_text(encoding="utf-8")
    for block in blocks(page, "toml"):
        for group, names in entry_points(block.text).items():
            assert names == ADDED[group]


def test_every_addition_of_the_example_is_listed(site: Path) -> None:
    listed = run(["me2e-compress", "list"], None, site)
    names = [name for group in ADDED.values() for name in group]
    assert [name for name in names if not re.search(rf"\b{name}\b", listed)] == []


@pytest.mark.parametrize(
    ("group", "where"),
    [(group, where) for group, names in ADDED.items() for where in names.values()],
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
