"""The code and the commands of the other documents."""

import contextlib
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest
import typer
from typer.main import get_command

from me2e_compress.cli.app import LazyGroup, app
from me2e_compress.errors import GraphError
from tests.docs.conftest import run
from tests.docs.pages import PAGES, ROOT, WRITING, Block, blocks

pytestmark = pytest.mark.xdist_group("installed")
OTHERS = [page for page in PAGES if page not in WRITING]
# the script of engine-dumps runs where an engine does; it has a test of its own
CODE = [p for p in OTHERS if blocks(p, "python") and p.stem != "engine-dumps"]

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


def commands() -> list[str]:
    """List every command line of the documents, continued lines joined."""
    found = []
    for page in PAGES:
        for block in blocks(page, "", "sh", "console"):
            text = block.text.replace("\\\n", " ")
            found += re.findall(r"^(me2e-compress .*)$", text, re.MULTILINE)
        found += re.findall(r"`(me2e-compress [^`]+)`", page.read_text("utf-8"))
    return list(dict.fromkeys(found))


@pytest.mark.parametrize("page", CODE, ids=lambda page: page.stem)
def test_the_code_of_a_page_runs(page: Path, folder: Path, site: Path) -> None:
    script = folder / "page.py"
    code = "".join(block.text for block in blocks(page, "python"))
    script.write_text(BEFORE.get(page.stem, "") + code)
    cells = "exec(open('page.py', encoding='utf-8').read())"  # it has no main guard
    run([sys.executable, "-c", cells], folder, site)


@pytest.mark.parametrize(
    "block",
    [block for page in PAGES for block in blocks(page, "toml")],
    ids=lambda block: block.text.splitlines()[0][:30],
)
def test_toml_is_toml(block: Block) -> None:
    assert tomllib.loads(block.text)


@pytest.mark.parametrize("line", commands())
def test_a_command_of_the_documents_is_one(line: str) -> None:
    """Its options exist and its values are of their types; nothing is run."""
    words = shlex.split(re.split(r"\s{3,}", line)[0], comments=True)[1:]
    group = get_command(app)
    assert isinstance(group, LazyGroup)
    name, command, rest = group.resolve_command(typer.Context(group), words)
    if rest and "..." not in line and "…" not in line:
        with contextlib.suppress(GraphError):  # the model is not there
            command.make_context(name, rest)
