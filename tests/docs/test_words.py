"""Names, docstrings and messages use the words of docs/words.md."""

import ast
import importlib
import re
from collections import Counter
from collections.abc import Iterator

import pytest

from tests.docs.pages import ROOT

TEXT = (ROOT / "docs" / "words.md").read_text(encoding="utf-8")
WORDS = [
    (word, room)
    for room, words in re.findall(r"^\* `([\w.]+)`: (.*)$", TEXT, re.MULTILINE)
    for word in re.findall(r"`([A-Z]\w+)`, ", words)
]
BANNED = ", ".join(re.findall(r"^\* not (.*), but ", TEXT, re.MULTILINE)).split(", ")
PATTERN = re.compile(
    r"(?<![a-z])(" + "|".join(map(re.escape, BANNED)) + r")s?(?![a-z])", re.IGNORECASE
)


def names_and_texts() -> Iterator[tuple[str, str, ast.AST]]:
    """Walk what a reader sees: names that are defined, docstrings and messages."""
    for path in sorted((ROOT / "me2e_compress").rglob("*.py")):
        where = path.relative_to(ROOT)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        yield str(where), path.stem, tree
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                text = re.sub(r"(?<=[a-z])(?=[A-Z])|_", " ", node.name)
                yield f"{where}:{node.lineno}", text, node
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield f"{where}:{node.lineno}", " ".join(node.value.split()), node


@pytest.mark.parametrize(("word", "room"), WORDS)
def test_a_word_is_where_the_page_says(word: str, room: str) -> None:
    assert getattr(importlib.import_module(room), word).__name__ == word


def test_a_word_stands_for_one_thing_and_private_ones_are_not_used() -> None:
    assert len(WORDS) > 25
    assert {"gauge", "race", "contender"} < set(BANNED)
    seen = list(names_and_texts())

    classes = Counter(n.name for _, _, n in seen if isinstance(n, ast.ClassDef))
    assert {word: classes[word] for word, _ in WORDS if classes[word] != 1} == {}
    assert [f"{at}: {text[:80]}" for at, text, _ in seen if PATTERN.search(text)] == []


def test_what_is_not_installed_is_said_to_be_in_the_repository() -> None:
    apart = re.compile(
        r"(?<![`/\w])(python -m [bm]|use benchmarks/|examples/|docs/w|models\.[a-z])"
    )
    named = [text for _, text, _ in names_and_texts() if apart.search(text)]
    assert len(named) > 1
    assert [text for text in named if "the repository" not in text] == []
