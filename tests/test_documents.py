import os
from collections.abc import Callable
from pathlib import Path

import pytest

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.errors import Me2eError
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.manager import recipe
from me2e_compress.quantization.plan import load_plan
from me2e_compress.quantization.plan.overrides import Overrides
from me2e_compress.registry import documents
from me2e_compress.registry.documents import MalformedError

DEEP = 100_000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * DEEP, "nested too deeply"),
        ('{"a":' * DEEP, "nested too deeply"),
        ("9" * 5000, "digits"),
        ("NaN", "NaN is not a number"),
        ('{"a": ["\\ud800"]}', "half a surrogate pair"),
        (b"\xff\xfe", "utf-8"),
        ('{"a": 1,}', "double quotes"),
    ],
)
def test_what_no_json_may_hold(text: bytes | str, message: str) -> None:
    with pytest.raises(MalformedError, match=message) as caught:
        documents.from_json(text)
    assert len(str(caught.value)) <= 200


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * DEEP, "nested too deeply"),
        ("a = " + "{a = " * DEEP, "nested too deeply"),
        ("a." * DEEP + "a = 1", "more than 64 parts"),
        ("[" + "'a' . " * 65 + "a]", "more than 64 parts"),
        ("a = " + "9" * 5000, "digits"),
        ("a = ", "Invalid value"),
    ],
)
def test_what_no_toml_may_hold(text: str, message: str) -> None:
    with pytest.raises(MalformedError, match=message):
        documents.from_toml(text)


def test_dots_in_a_string_are_no_key() -> None:
    text = f'a = "{"x." * 99}"\nb = [{"1.5, " * 99}]'
    assert len(documents.from_toml(text)["b"]) == 99


def test_a_pipe_is_no_text_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(MalformedError, match="not a regular file"):
        documents.content(tmp_path / "pipe")


def test_a_document_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "scenes.json"
    with path.open("wb") as file:
        file.truncate(documents.LARGEST_BYTES + 1)
    with pytest.raises(
        MalformedError, match="64,000,001 bytes are too many: 64,000,000"
    ):
        documents.content(path)


def test_toml_is_bounded_before_it_is_parsed() -> None:
    with pytest.raises(MalformedError, match="are too many: 4,000,000 may be"):
        documents.from_toml("#" * 4_000_001)


@pytest.mark.parametrize(
    "load",
    [ModuleMap.load, load_plan, Overrides.load, Ranges.load, recipe.load],
    ids=["map", "plan", "overrides", "ranges", "recipe"],
)
def test_every_document_of_the_user_is_bounded(
    tmp_path: Path, load: Callable[[Path], object]
) -> None:
    path = tmp_path / "large.toml"
    with path.open("wb") as file:
        file.truncate(documents.LARGEST_BYTES + 1)
    with pytest.raises(Me2eError, match=r"large\.toml.*64,000,001 bytes are too many"):
        load(path)
