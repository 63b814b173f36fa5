"""A README that is read in five minutes, and whose commands run as they stand."""

import re
import shlex
import sys
from pathlib import Path

import pytest

from me2e_compress.cli import main
from me2e_compress.cli.app import COMMANDS
from tests.docs.pages import ROOT, blocks

README = ROOT / "README.md"
TEXT = README.read_text(encoding="utf-8")


def test_it_is_read_in_five_minutes() -> None:
    assert len(TEXT.split()) <= 700
    assert len(TEXT.splitlines()) <= 100


def test_the_index_leads_to_every_page() -> None:
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    pages = {page.name for page in (ROOT / "docs").glob("*.md")}
    linked = set(re.findall(r"\]\(([\w-]+\.md)\)", index))
    assert pages - linked == {"README.md", "package.md"}  # the latter is the wheel's


def commands(language: str) -> list[tuple[list[str], list[str]]]:
    """Read the commands of a block, and the lines that each is said to print."""
    found: list[tuple[list[str], list[str]]] = []
    for block in blocks(README, language):
        for line in block.text.splitlines():
            if line.startswith(("$ ", "me2e-compress ")):
                words = shlex.split(line.removeprefix("$ "), comments=True)
                found.append((words, []))
            elif found:
                found[-1][1].append(line)
    return found


def test_every_command_of_it_is_one() -> None:
    said = [words for words, _ in (*commands("console"), *commands(""))]
    said = [words for words in said if words[0] == "me2e-compress"]
    assert len(said) == 9
    assert {words[1] for words in said} <= set(COMMANDS)


@pytest.mark.slow
def test_the_six_commands_run_and_print_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    six = commands("console")
    assert len(six) == 6
    for words, lines in six:
        monkeypatch.setattr(sys, "argv", words)
        assert main() == 0, words
        shown = _without_figures(capsys.readouterr().out)
        for line in lines:
            assert _without_figures(line) in shown


def _without_figures(text: str) -> str:
    """Leave out what differs from machine to machine, and where lines are broken."""
    return " ".join(re.sub(r"[\d.,]+", "#", text).split())
