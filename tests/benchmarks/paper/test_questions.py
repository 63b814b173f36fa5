"""Questions as data: which files are taken, and what decides one."""

from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from benchmarks.paper.__main__ import PAGE
from benchmarks.paper.questions import PaperQuestion, PaperQuestions, PAt
from me2e_compress.study import load_study

SHIPPED = PaperQuestions.load()
Side = Literal["above", "below", "within"]


def about(value: float, error: float = 1.0) -> PAt:
    """Two-sided p-values of a normal estimate."""
    return lambda edge: 2.0 * float(norm.sf(abs(value - edge) / error))


def certain(edge: float) -> float:
    return 0.0


def question(
    holds: Side, edge: float = 0.0, turned: float | None = None
) -> PaperQuestion:
    return PaperQuestion(
        "a", "?", "", of="x.y", minus="z.y", holds=holds, edge=edge, turned=turned
    )


@pytest.mark.parametrize("asked", SHIPPED.question, ids=lambda each: each.name)
def test_no_test_fails_the_papers_own_figures(asked: PaperQuestion) -> None:
    for figure in asked.figures:
        assert asked.judge(figure, certain) == (1, 0.0)


def test_every_question_asks_of_drives_that_the_study_makes() -> None:
    study = load_study(PAGE.study, "1")
    driven = {
        f"{variant.name}.{condition.name}"
        for condition in study.conditions
        for variant in study.driven_under(condition)
    }

    asked = {drive for each in SHIPPED.question for drive in each.drives}

    assert asked <= driven


@pytest.mark.parametrize(
    ("asked", "sides"),
    [
        (question("above"), {0.1: 1, -0.1: -1}),
        (question("below"), {-0.1: 1, 0.1: -1}),
        (question("above", -2.0), {-1.9: 1, -2.1: -1}),
        (question("above", 6.0, 1.0), {6.1: 1, 1.3: 0, 0.9: -1}),
        (question("within", 10.0), {-7.8: 1, -36.9: -1}),
    ],
)
def test_the_side_of_a_value(asked: PaperQuestion, sides: dict[float, int]) -> None:
    assert {value: asked.judge(value, certain)[0] for value in sides} == sides


VALUES, MARGINS = st.floats(-20, 20), st.floats(0.0, 10.0)


@given(VALUES, st.sampled_from(["above", "below", "within"]), MARGINS)
def test_a_shift_makes_no_verdict_easier(
    value: float, holds: Side, shift: float
) -> None:
    asked, p_at = question(holds, 2.0 if holds == "within" else 0.0), about(value)
    side, p = asked.judge(value, p_at)

    shifted, other = asked.judge(value, p_at, shift)

    assert shifted in (side, 0)
    assert other >= p or shifted == 0
    assert asked.judge(value, p_at, np.inf) == (0, 1.0)
