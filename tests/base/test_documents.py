import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from me2e_compress.base import documents
from me2e_compress.base.documents import MalformedError, from_json, from_toml
from me2e_compress.base.errors import Me2eError
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import recipe
from me2e_compress.quantization.decision import Overrides, load_plan

DEEP = 100_000


@pytest.mark.parametrize(
    ("parse", "text", "message"),
    [
        (from_json, "[" * DEEP, "nested too deeply"),
        (from_json, '{"a":' * DEEP, "nested too deeply"),
        (from_json, "9" * 5000, "digits"),
        (from_json, "NaN", "NaN is not a number"),
        (from_json, '{"a": ["\\ud800"]}', "half a surrogate pair"),
        (from_json, b"\xff\xfe", "utf-8"),
        (from_json, '{"a": 1,}', "double quotes"),
        (from_toml, "a = " + "[" * DEEP, "nested too deeply"),
        (from_toml, "a = " + "{a = " * DEEP, "nested too deeply"),
        (from_toml, "a = " + "9" * 5000, "digits"),
        (from_toml, "a = ", "Invalid value"),
        (from_toml, "#" * 4_000_001, "are too many: 4,000,000 may be"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_what_no_document_may_hold(
    parse: Callable[[Any], object], text: bytes | str, message: str
) -> None:
    with pytest.raises(MalformedError, match=message) as caught:
        parse(text)
    assert len(str(caught.value)) <= 200


def test_a_pipe_is_no_text_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(MalformedError, match="not a regular file"):
        documents.read_bytes(tmp_path / "pipe")


@pytest.mark.parametrize(
    "load", [ModuleMap.load, load_plan, Overrides.load, Ranges.load, recipe.load]
)
def test_every_document_of_the_user_is_bounded(
    tmp_path: Path, load: Callable[[Path], object]
) -> None:
    path = tmp_path / "large.toml"
    with path.open("wb") as file:
        file.truncate(documents.LARGEST_BYTES + 1)
    words = r"large\.toml.*64,000,001 bytes are too many: 64,000,000"
    with pytest.raises(Me2eError, match=words):
        load(path)
