import os
from pathlib import Path

import pytest

from me2e_compress import documents
from me2e_compress.documents import MalformedError

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
