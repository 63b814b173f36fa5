"""What the README of the models names is there, and its Python runs."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "models" / "README.md").read_text("utf-8")


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`(models/[\w/.]+)`", TEXT))))
def test_a_file_it_names_is_there(path: str) -> None:
    assert (ROOT / path).exists()


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\(([^)#]+)", TEXT))))
def test_a_page_it_links_is_there(link: str) -> None:
    assert (ROOT / "models" / link).exists()


def test_its_examples_name_what_exists() -> None:
    policy, course = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(policy, "README.md", "exec"), names)
    head, _, _ = course.partition("\ncourse = ")
    exec(compile(head, "README.md", "exec"), names)
    assert {"drive", "FULL", "HighwayConfig", "run"} <= set(names)
