"""Every command that prints a document has a section in docs/json.md, and only those.

The documents themselves are held against the page where the commands are tested.
"""

import pytest

from benchmarks.tools.json_page import page
from me2e_compress.cli.app import COMMANDS
from tests.docs.documents import EVERY, PAGE, faults, sections

GOOD = {
    "schema": 3,
    "status": "ok",
    "verdict": ["done"],
    "budgets": [{"unit": "s", "limit": 1.0}],
    "tried": [],
}
TRIED: dict[str, object] = {
    "modules": ["head"],
    "loss": 0.1,
    "costs": [1],
    "score": None,
    "measured_costs": None,
}


def test_the_page_is_what_the_classes_say() -> None:
    assert PAGE.read_text("utf-8") == page()


def test_the_page_has_no_other_section() -> None:
    assert set(sections()) == {EVERY, *COMMANDS}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({}, []),
        ({"tried": "17"}, ["tried is a str"]),
        ({"more": 1}, ["more is not documented"]),
        ({"verdict": [1]}, ["verdict[] is a int"]),
        ({"budgets": [{"unit": None, "limit": 1}]}, ["budgets[].unit is a NoneType"]),
        ({"tried": [TRIED]}, []),
    ],
)
def test_what_differs_from_the_page_is_found(
    change: dict[str, object], fault: list[str]
) -> None:
    assert faults("search", {**GOOD, **change}) == fault
    lacking = {key: value for key, value in GOOD.items() if key not in change}
    assert faults("search", lacking) == [
        f"{key} is missing" for key in change if key in GOOD
    ]
