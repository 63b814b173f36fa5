"""Every command that prints a document has a section in docs/json.md, and only those.

The documents themselves are held against the page where the commands are tested.
"""

import pytest

from me2e_compress.cli.app import COMMANDS
from tests.docs.documents import EVERY, faults, sections

GOOD = {
    "schema": 1,
    "status": "ok",
    "verdict": ["done"],
    "stack": "highway",
    "output": "m.onnx",
    "opset": 17,
    "bytes": 1,
    "weights": None,
}


def test_the_page_has_no_other_section() -> None:
    assert set(sections()) == {EVERY, *COMMANDS}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({}, []),
        ({"opset": "17"}, ["opset is ['string'], not ['integer']"]),
        ({"more": 1}, ["more is not documented"]),
    ],
)
def test_what_differs_from_the_page_is_found(
    change: dict[str, object], fault: list[str]
) -> None:
    assert faults("export", {**GOOD, **change}) == fault


def test_a_key_that_is_missing_is_found() -> None:
    lacking = {key: value for key, value in GOOD.items() if key != "bytes"}

    assert faults("export", lacking) == ["bytes is missing"]
