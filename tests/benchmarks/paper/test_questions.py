"""Questions as data: which files are taken, and what decides one."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from benchmarks.paper.__main__ import PAGES
from benchmarks.paper.published import (
    INT8,
    LIMITED,
    MODULES_AWAY,
    MODULES_AWAY_OF_VAD,
    RATES,
    RATES_RT,
    PublishedDrive,
)
from benchmarks.paper.questions import PaperQuestion, PaperQuestions, PAt
from me2e_compress.errors import StudyError
from me2e_compress.study import load_study

SHIPPED = PaperQuestions.load()
Side = Literal["above", "below", "within"]
HEAD = 'interval = "types"\ncorrection = "holm"\nalpha = 0.05\nstep = 2.0\n'
ASKED = '[[question]]\nname = "a"\nasks = "?"\npaper = ""\n'
DRIVES = 'of = "x.y"\nminus = "z.y"\n'


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


def at(fps: float) -> float:
    return next(row.ds for row in RATES if row.fps == fps)


def away(name: str, stack: dict[str, PublishedDrive] = MODULES_AWAY) -> float:
    return stack[name].ds - stack["float"].ds


def test_the_figures_are_those_of_the_papers_tables() -> None:
    figures = {each.name: each.figures for each in SHIPPED.question}
    fast, ten, four = (row.ds for row in LIMITED)
    told = {
        "rate-20": [at(20) - at(1)],
        "rate-below-10": [at(10) - at(1) - (at(20) - at(10))],
        "rate-above-24": [at(30) - at(24)],
        "rate-10": [ten - four - (fast - ten)],
        "rate-4": [four - fast],
        "tail": [RATES_RT["UniAD"].ds - at(2)],
        "occ": [away("minus-occ")],
        "map": [away("minus-map")],
        "map-vad": [away("map", MODULES_AWAY_OF_VAD)],
        "motion": [away("minus-motion"), away("motion", MODULES_AWAY_OF_VAD)],
        "motion-occ": [away("minus-occ-motion") - away("minus-occ")],
        "map-motion": [
            away("minus-map-motion"),
            away("map-motion", MODULES_AWAY_OF_VAD),
        ],
        "occ-map": [away("minus-occ-map")],
        "occ-map-motion": [away("minus-occ-map-motion")],
        "whole-way": [INT8["feature-ext"].ds - MODULES_AWAY["float"].ds],
    }

    for name, expected in told.items():
        assert list(figures[name]) == pytest.approx(expected, abs=0.005), name
    assert figures["int8-full"][0] == pytest.approx(INT8["full"].ds - INT8["exact"].ds)


def test_every_question_asks_of_drives_that_the_study_makes() -> None:
    study = load_study(PAGES[1].study, "1")
    driven = {
        f"{variant.name}.{condition.name}"
        for condition in study.conditions
        for variant in study.driven_under(condition)
    }

    asked = {drive for each in SHIPPED.question for drive in each.drives}

    assert asked <= driven


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "interval: "),
        (HEAD, "question: "),
        (HEAD + ASKED, "question a: give of and minus, bend, or why it is untested"),
        (HEAD + ASKED + 'of = "x.y"\n', "question a: give of and minus"),
        (HEAD + ASKED + 'of = "x"\nminus = "y"\n', "a drive is VARIANT.CONDITION"),
        (HEAD + ASKED + DRIVES + "margin = 2\n", "margin: Unexpected keyword"),
        (HEAD + ASKED + DRIVES + 'edge = "2"\n', "edge: "),
        (HEAD + ASKED + DRIVES + 'holds = "maybe"\n', "holds: "),
        (HEAD + (ASKED + DRIVES) * 2, "2 questions are named a"),
        (HEAD.replace("holm", "none") + ASKED + DRIVES, "correction: "),
        (HEAD.replace("0.05", "nan") + ASKED + DRIVES, "alpha: "),
        (HEAD.replace("0.05", "5") + ASKED + DRIVES, "alpha 5 and step 2: "),
        ("=", "not questions: "),
    ],
)
def test_bad_questions_are_refused_in_one_line(
    tmp_path: Path, text: str, said: str
) -> None:
    path = tmp_path / "asked.toml"
    path.write_text(text)

    with pytest.raises(StudyError) as caught:
        PaperQuestions.load(path)

    told = str(caught.value)
    assert told.startswith(f"{path}: not questions: ")
    assert said.lower() in told.lower()
    assert "\n" not in told


@pytest.mark.parametrize(
    ("asked", "value", "side"),
    [
        (question("above"), 0.1, 1),
        (question("above"), -0.1, -1),
        (question("below"), -0.1, 1),
        (question("below"), 0.1, -1),
        (question("above", -2.0), -1.9, 1),
        (question("above", -2.0), -2.1, -1),
        (question("above", 6.0, 1.0), 6.1, 1),
        (question("above", 6.0, 1.0), 1.3, 0),
        (question("above", 6.0, 1.0), 0.9, -1),
        (question("within", 10.0), -7.8, 1),
        (question("within", 10.0), -36.9, -1),
    ],
)
def test_the_side_of_a_value(asked: PaperQuestion, value: float, side: int) -> None:
    assert asked.judge(value, certain)[0] == side


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
