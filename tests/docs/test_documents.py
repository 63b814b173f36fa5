"""Every command that prints a document has a section in docs/json.md, and only those.

The documents themselves are held against the page where the commands are tested.
"""

import pytest

from benchmarks.json_page import page
from me2e_compress.cli.app import COMMANDS
from tests.docs.documents import EVERY, PAGE, faults, sections

GOOD = {
    "schema": 3,
    "status": "ok",
    "verdict": ["done"],
    "stack": "highway",
    "output": "m.onnx",
    "opset": 17,
    "weights": None,
}
WEIGHTS: dict[str, object] = {
    "file": "m.pth",
    "sha256": "0",
    "epoch": None,
    "iteration": 3,
    "averaged": False,
    "converted": {},
    "unread": ["head.weight"],
    "averages": 0,
}


def test_the_page_is_what_the_classes_say() -> None:
    assert PAGE.read_text("utf-8") == page()


def test_the_page_has_no_other_section() -> None:
    assert set(sections()) == {EVERY, *COMMANDS}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({}, []),
        ({"opset": "17"}, ["opset is a str"]),
        ({"more": 1}, ["more is not documented"]),
        ({"verdict": [1]}, ["verdict[] is a int"]),
        ({"weights": {**WEIGHTS, "sha256": None}}, ["weights.sha256 is a NoneType"]),
        ({"weights": {**WEIGHTS, "converted": {"float16": 2}}}, []),
    ],
)
def test_what_differs_from_the_page_is_found(
    change: dict[str, object], fault: list[str]
) -> None:
    assert faults("export", {**GOOD, **change}) == fault


def test_a_key_that_is_missing_is_found() -> None:
    lacking = {key: value for key, value in GOOD.items() if key != "opset"}

    assert faults("export", lacking) == ["opset is missing"]
