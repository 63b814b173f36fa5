import dataclasses

import pytest

from me2e_compress.display import Cell, Table
from me2e_compress.study import StudyResult
from me2e_compress.study.cells import (
    INFINITE,
    MINUS,
    MISSING,
    estimate_cell,
    measure_cell,
    number,
)
from me2e_compress.study.study_result import (
    abilities,
    differences,
    near_misses,
    scoreboards,
)
from tests.study.conftest import IDEAL

pytestmark = pytest.mark.xdist_group("study")


def test_a_scoreboard_a_condition_and_a_row_a_variant(found: StudyResult) -> None:
    ideal, slow = scoreboards(found)

    assert ideal.title == "Scoreboard, ideal: decisions cost no time"
    assert slow.title == "Scoreboard, slow: 2 decisions a second"
    assert [row[0].text for row in ideal.rows] == ["blind", "slow", "again", "fast"]
    assert all(len(row) == len(ideal.columns) for row in ideal.rows)
    assert ideal.strong == "slow"
    assert "2 of 220 routes" in ideal.note


def test_the_numbers_are_those_of_the_drives(found: StudyResult) -> None:
    scores = found.under(IDEAL)[3].scores
    assert scores is not None

    row = scoreboards(found)[0].rows[3]

    assert row[1] == estimate_cell(scores.driving_score)
    assert row[2] == estimate_cell(scores.safety.room_kept)
    assert row[4] == estimate_cell(scores.efficiency)
    assert row[5] == estimate_cell(scores.bench2drive_efficiency)
    assert row[7] == estimate_cell(scores.bench2drive_smoothness)
    assert row[9] == measure_cell(found.variants[3].latency_ms[50], ".1f")
    assert row[11].text == "7.000"


def test_a_driver_without_a_model_has_reasons_not_numbers(found: StudyResult) -> None:
    row = scoreboards(found)[0].rows[0]

    assert [cell.text for cell in row[8:]] == [MISSING] * 5
    assert all(cell.reason for cell in row[8:])


def test_no_noise_is_not_a_gap(found: StudyResult) -> None:
    assert scoreboards(found)[0].rows[2][12].text == INFINITE


def test_the_baseline_is_not_compared_with_itself(found: StudyResult) -> None:
    table = differences(found)

    assert table.title == "Difference to slow on the same routes"
    assert [row[0].text for row in table.rows] == [
        f"{variant}, {condition}"
        for condition in ("ideal", "slow")
        for variant in ("blind", "again", "fast")
    ]
    # nothing differed: what two routes leave open, 1 - 0.05 ** (1 / 2)
    assert table.rows[1][1] == Cell("+0.0", f"{MINUS}77.6 to +77.6")


def test_the_note_says_how_many_were_compared_and_what_may_be_unseen(
    found: StudyResult,
) -> None:
    note = differences(found).note

    assert (
        "corrected for 6 comparisons (Holm). Each interval is a 95 % interval" in note
    )
    assert "one in twenty misses zero by chance where nothing differs." in note
    assert "Where 0 of 2 routes differ, at most 77.6 % do (95 %)." in note


def test_abilities_have_their_mean_last(found: StudyResult) -> None:
    table = abilities(found)[0]

    assert table.columns[1:] == (
        *("Overtaking", "Merging", "Emergency Brake", "Give Way", "Traffic Signs"),
        "mean",
    )
    assert table.rows[0][-1].reason.startswith("no route for Merging")


def test_one_variant_has_one_scoreboard_of_its_conditions(found: StudyResult) -> None:
    study = dataclasses.replace(
        found.study, variants=found.study.variants[1:2], baseline="slow"
    )
    drives = tuple(each for each in found.drives if each.variant == "slow")
    alone = dataclasses.replace(
        found, study=study, variants=found.variants[1:2], drives=drives
    )

    [table] = scoreboards(alone)
    [mastered] = abilities(alone)

    assert table.columns[1:6] == ("DS", "room %", "SR %", "DE %", "DE b2d %")
    assert table.columns[6:] == ("DC", "DC b2d")
    assert [row[0].text for row in mastered.rows] == ["ideal", "slow"]
    assert [row[0].text for row in table.rows] == ["ideal", "slow"]
    assert "Difference" not in "".join(each.title for each in alone.tables())


def test_markdown() -> None:
    table = Table(
        "Costs",
        ("variant", "DS"),
        (
            (Cell("a|b"), Cell("1.0", "0.5 to 1.5")),
            (Cell("c"), Cell(MISSING, reason="no")),
        ),
        "Note.",
    )

    assert table.markdown() == (
        "**Costs**\n\n| variant | DS |\n|---|---:|\n"
        f"| a\\|b | 1.0 (0.5 to 1.5) |\n| c | {MISSING} |\n\nNote.\n"
    )


@pytest.mark.parametrize(
    ("value", "form", "text"),
    [
        (-0.04, ".1f", "0.0"),
        (-0.04, "+.1f", "+0.0"),
        (-0.4, "+.1f", f"{MINUS}0.4"),
        (12.34, ".1f", "12.3"),
        (-5.0, ".0f", f"{MINUS}5"),
    ],
)
def test_numbers(value: float, form: str, text: str) -> None:
    assert number(value, form) == text


def test_near_misses_of_every_drive(found: StudyResult) -> None:
    table = near_misses(found)

    assert len(table.rows) == len(found.drives)
    slow = {row[0].text: row for row in table.rows}["slow, ideal"]
    assert slow[4].text != MISSING
    assert slow[4].detail
