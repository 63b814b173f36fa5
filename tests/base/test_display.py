"""A plan as a table; how numbers are written."""

import pytest

from me2e_compress.base.display import (
    error_line,
    format_number,
    format_significant,
    missing_note,
    plural,
    with_prefix,
)
from me2e_compress.quantization.decision import Decision, QuantPlan, QuantScheme


def test_a_plan_has_a_row_a_module_with_the_rules_that_kept_float() -> None:
    rules = [("int8", "layer")] * 3 + [("float", "small-product"), ("float", "gemv")]
    decisions = tuple(
        Decision(f"n{at}", f"o{at}", "MatMul", "head", dtype, rule, "it is", ())
        for at, (dtype, rule) in enumerate(rules)
    )
    (shown,) = QuantPlan(QuantScheme("full", ("head",)), decisions).tables()

    cells = [[cell.text for cell in row] for row in shown.rows]
    assert cells == [["head", "gemv 1, small-product 1", "3", "2"]]


@pytest.mark.parametrize(
    ("value", "form", "text"),
    [
        (-0.001, ".2f", "0.00"),
        (-0.001, "+.2f", "+0.00"),
        (-0.01, "+.2f", "-0.01"),
        (-4.6, ",.0f", "-5"),
        (-0.0, "g", "0"),
        (0, ".1f", "0.0"),
        (None, ".2f", "-"),
    ],
)
def test_no_number_is_negative_zero(value: float | None, form: str, text: str) -> None:
    assert format_number(value, form) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (4_778_000.0, "4,778,000"),
        (1_234_567.0, "1,234,567"),
        (5.412e-05, "0.00005412"),
        (1e-12, "0.000000000001"),
        (50.0, "50"),
        (-1.67, "-1.67"),
        (0.0, "0"),
        (float("inf"), "inf"),
        (None, "-"),
    ],
)
def test_no_number_is_in_powers_of_ten(value: float | None, text: str) -> None:
    assert format_significant(value) == text


@pytest.mark.parametrize(
    ("count", "text"),
    [
        *((1, "1 thread"), (0, "0 threads"), (2000, "2,000 threads")),
        *((1.0, "1 thread"), (1.67, "1.67 threads")),
    ],
)
def test_one_is_singular(count: float, text: str) -> None:
    assert plural(count, "thread") == text


def test_lines_say_who_and_why_once() -> None:
    assert with_prefix("battery", "none here") == "battery: none here"
    assert with_prefix("battery", "battery: none here") == "battery: none here"
    assert error_line(EOFError()) == "EOFError"
    assert error_line(ValueError("two\n lines")) == "two lines"


def test_what_is_not_measured_is_told_once_a_reason() -> None:
    why = {"  Merging": "no route", "p99": "too few", "Give_Way": "no route"}

    assert missing_note({}) == ""
    assert (
        missing_note(why)
        == "Not measured: Merging, Give_Way (no route); p99 (too few)."
    )
