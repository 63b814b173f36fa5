"""Names, docstrings and messages use the words of docs/words.md."""

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.docs.pages import ROOT

TEXT = (ROOT / "docs" / "words.md").read_text(encoding="utf-8")
WORDS = [
    (word, room)
    for room, words in re.findall(r"^\* `([\w.]+)`: (.*)$", TEXT, re.MULTILINE)
    for word in re.findall(r"`([A-Z]\w+)`, ", words)
]
BANNED = [
    word.strip()
    for words in re.findall(r"^\* not (.*), but ", TEXT, re.MULTILINE)
    for word in words.split(",")
]
FILES = sorted((ROOT / "me2e_compress").rglob("*.py"))
PATTERN = re.compile(
    r"(?<![a-z])(" + "|".join(map(re.escape, BANNED)) + r")s?(?![a-z])", re.IGNORECASE
)


def names_and_texts(path: Path) -> Iterator[tuple[int, str]]:
    """Walk what a reader sees: names that are defined, docstrings and messages."""
    yield 0, path.stem
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.lineno, re.sub(r"(?<=[a-z])(?=[A-Z])|_", " ", node.name)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, " ".join(node.value.split())


def test_the_tables_are_read() -> None:
    assert len(WORDS) > 25
    assert {"gauge", "race", "contender"} < set(BANNED)


@pytest.mark.parametrize(("word", "room"), WORDS)
def test_a_word_is_where_the_page_says(word: str, room: str) -> None:
    assert getattr(importlib.import_module(room), word).__name__ == word


@pytest.mark.parametrize("word", [word for word, _ in WORDS])
def test_a_word_stands_for_one_thing(word: str) -> None:
    defined = [
        path.relative_to(ROOT)
        for path in FILES
        if re.search(
            rf"^class {word}\b", path.read_text(encoding="utf-8"), re.MULTILINE
        )
    ]
    assert len(defined) == 1, defined


def test_private_words_are_not_used() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text[:80]}"
        for path in FILES
        for line, text in names_and_texts(path)
        if PATTERN.search(text)
    ]
    assert not found, "\n".join(found)
