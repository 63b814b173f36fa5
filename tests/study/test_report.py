import json
import re
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from markupsafe import Markup

from me2e_compress.base.atomic import IN_JSON, IN_MARKDOWN, is_marked
from me2e_compress.base.display import Cell, Table
from me2e_compress.base.errors import StudyError
from me2e_compress.runtime.latency_trace import Load
from me2e_compress.study import StudyResult
from me2e_compress.study.cells import (
    INFINITE,
    MINUS,
    MISSING,
    estimate_cell,
    measure_cell,
)
from me2e_compress.study.report.figures import (
    ACCENT,
    MOST_DRIVES,
    MUTED,
    answer,
    differences,
    road,
    svg,
)
from me2e_compress.study.report.page import (
    TIMES,
    Drawing,
    Page,
    Section,
    findings,
    study_page,
    write_study,
)
from me2e_compress.study.study_result import (
    MOST_ROUTES,
    abilities,
    difference_table,
    near_misses,
    route_tables,
    scoreboard,
)
from tests.study.conftest import IDEAL, ROUTES

pytestmark = pytest.mark.xdist_group("study")


@pytest.fixture(scope="module")
def page(result: StudyResult) -> str:
    return study_page(result, ("me2e-compress", "study", "<s>.toml")).html()


def test_the_page_needs_nothing_beside_it_and_is_the_same_again(
    result: StudyResult, page: str
) -> None:
    links = re.findall(r"""(?:src|href)=["']([^"']*)["']|url\(([^)]*)\)""", page)

    assert all((one or other).startswith("#") for one, other in links)
    assert study_page(result, ("me2e-compress", "study", "<s>.toml")).html() == page


def test_a_preview_is_named_so_in_every_title_and_the_headline(page: str) -> None:
    titles = re.findall(r"<(?:h1|title)>(.*?)<|<summary>((?!How it).*?)<", page)

    assert len(titles) >= 6
    assert all("(preview: 2 of 220 routes)" in f"{a}{b}" for a, b in titles)
    assert "2 routes cannot show a difference below 77.6 points of driving" in page
    assert ", all 220 none below 3.4." in page
    assert "Decisions cost no time under ideal: no latency shows there." in page


def test_the_checkpoint_stands_where_a_variant_was_made(result: StudyResult) -> None:
    first, *others = result.variants
    first = replace(first, weights="a.pth")
    named = replace(result, variants=(first, *others))

    assert "; weights: a.pth</code>" in study_page(named).html()


def test_a_busy_machine_is_said_above_all(result: StudyResult) -> None:
    idle = replace(result, load=Load(0.1, 2))
    busy = replace(result, load=Load(1.3, 2))
    words = "the machine was busy: other processes took 1.3 of 2 cores"

    assert busy.alerts()[-1].startswith(words)
    assert f'<p class="alert">{words}' in study_page(busy).html()
    assert idle.alerts() == replace(result, load=None).alerts()
    assert "timed, other processes took 0.1 of 2 cores" in study_page(idle).html()


def test_each_route_has_its_end_unless_there_are_many(result: StudyResult) -> None:
    (table,) = route_tables(result)

    assert table is not None
    assert table.columns[:2] == ("route", "blind, ideal")
    assert [row[0].text for row in table.rows] == [route.id for route in ROUTES]
    ends = {cell.detail for row in table.rows for cell in row[1:]}
    assert "collision with a vehicle; room 0 %" in ends
    many = (
        replace(drive, routes=drive.routes * MOST_ROUTES) for drive in result.drives
    )
    assert route_tables(replace(result, drives=tuple(many))) == ()


def test_the_answer_has_a_row_a_variant_and_a_mark_a_drive(result: StudyResult) -> None:
    drawn = str(answer(result))

    # names, costs as shares, the plan, and every drive with its interval
    for words, count in (
        ("again", 1),
        ("0.00 (129 %)", 1),
        ("200.0", 1),
        ("7.00 (at most 12.00)", 1),
        ("the reference", 1),
        ("ideal: 17.1 (16.1 to 18.1)", 1),
        (MISSING, 3),
    ):
        assert drawn.count(f">{words}</text>") == count, words
    # a drive that was not made, and one condition alone
    ideal = [drive for drive in result.drives if drive.condition == IDEAL.name]
    row = tuple(replace(drive, scores=None) for drive in ideal)
    study = replace(result.study, conditions=(IDEAL,))
    ideal_alone = answer(replace(result, study=study, drives=row))
    assert ideal_alone.count(">not driven<") == 4


def test_of_many_drives_the_answer_has_one_condition(result: StudyResult) -> None:
    drives = result.drives * (1 + MOST_DRIVES // len(result.drives))
    many = replace(result, drives=drives)

    assert ">slow: " not in answer(many)
    assert ">Driving score, 0 to 100</text>" in road(many)
    assert ">Driving score, 0 to 100</text>" not in road(result)
    page = study_page(many).html()
    assert "Driving scores are those under ideal." in page
    assert page.split("<details>")[0].count("<svg") == 1


def test_what_is_sure_is_filled(result: StudyResult) -> None:
    drawn = str(differences(result))

    assert f">+3.6 ({MINUS}76.8 to +78.5)</text>" in drawn
    assert ">fast, slow</text>" in drawn
    assert f"fill: {ACCENT}" not in drawn
    assert drawn.count(f"fill: #ffffff; stroke: {MUTED}") == 3 * len(result.drives) - 6
    (sure,) = (e for e in result.drives if (e.variant, e.condition) == ("fast", "slow"))
    assert sure.difference is not None
    gap = replace(sure.difference.driving_score, low=-50.0, high=-20.0)
    sure = replace(sure, difference=replace(sure.difference, driving_score=gap))
    assert f"fill: {ACCENT}" in str(differences(replace(result, drives=(sure,))))
    alone = replace(result, drives=result.drives[1:2])
    assert differences(alone) is None
    assert "<h2>Differences" not in study_page(alone).html()


def test_a_page_of_a_comparison_is_folded_but_for_its_pictures(page: str) -> None:
    head, *rest = page.split("<details>")

    assert head.count("<svg") == 2
    assert "<table" not in head
    assert sum(text.count("<table") for text in rest) == page.count("<table") >= 6
    assert head.index("<svg") < head.index('<ul class="findings">')


def test_findings_give_costs_and_what_is_sure(result: StudyResult) -> None:
    sentences = dict(findings(result))

    assert list(sentences) == ["blind", "again", "fast"]
    assert sentences["again"].startswith(f"1.00 {TIMES} the size, ")
    alike = f"ideal: driving score +0.0 points ({MINUS}77.6 to +77.6), too few routes"
    assert alike in sentences["again"]
    assert "size" not in sentences["blind"]


def test_files_are_written_beside_each_other(
    result: StudyResult, tmp_path: Path
) -> None:
    written = write_study(result, tmp_path / "new" / "study")

    assert json.loads(written.record.read_text()) == IN_JSON | result.to_json()
    assert written.tables.read_text().startswith(
        f"{IN_MARKDOWN}# Slow &amp; &lt;fast&gt; (preview: 2 of 220 routes)\n\n"
        "**Scoreboard (preview"
    )
    assert written.report.read_text().startswith("<!doctype html>")
    assert all(map(is_marked, (tmp_path / "new" / "study").iterdir()))
    found_files = {path.name for path in (tmp_path / "new" / "study").iterdir()}
    assert found_files == {"report.html", "study.json", "tables.md"}
    with pytest.raises(StudyError, match=r"tables\.md/study: cannot be written"):
        write_study(result, written.tables / "study")


def test_a_scoreboard_has_a_row_a_drive(result: StudyResult) -> None:
    board = scoreboard(result)

    assert [row[0].text for row in board.rows] == [
        f"{variant}, {condition}"
        for condition in ("ideal", "slow")
        for variant in ("blind", "slow", "again", "fast")
    ]
    assert all(len(row) == len(board.columns) for row in board.rows)
    assert board.strong == "slow"
    note = "ideal: latency none; slow: latency fps:2. 2 of 220 routes."
    assert board.note.startswith(note)
    # its numbers are those of the drives
    ideal = [drive for drive in result.drives if drive.condition == IDEAL.name]
    scores = ideal[3].scores
    assert scores is not None
    blind, _, again, row, *_ = board.rows
    assert row[1] == estimate_cell(scores.driving_score)
    assert row[2] == estimate_cell(scores.safety.room_kept)
    assert row[4] == estimate_cell(scores.efficiency)
    assert row[5] == estimate_cell(scores.bench2drive_efficiency)
    assert row[7] == estimate_cell(scores.bench2drive_smoothness)
    assert row[9] == measure_cell(result.variants[3].latency_ms[50], ".1f")
    assert row[11].text == "7.000"
    assert again[12].text == INFINITE  # no noise is not a gap
    assert [cell.text for cell in blind[8:]] == [MISSING] * 5
    assert all(cell.reason for cell in blind[8:])


def test_the_baseline_is_not_compared_with_itself(result: StudyResult) -> None:
    table = difference_table(result)

    assert table.title == "Difference to slow on the same routes"
    assert [row[0].text for row in table.rows] == [
        f"{variant}, {condition}"
        for condition in ("ideal", "slow")
        for variant in ("blind", "again", "fast")
    ]
    # nothing differed: what two routes leave open, 1 - 0.05 ** (1 / 2)
    assert table.rows[1][1] == Cell("+0.0", f"{MINUS}77.6 to +77.6")
    for words in (
        "corrected for 6 comparisons (Holm). Each interval is a 95 % interval",
        "one in twenty misses zero by chance where nothing differs.",
        "Where 0 of 2 routes differ, at most 77.6 % do (95 %).",
    ):
        assert words in table.note


def test_abilities_have_their_mean_last_and_every_drive_has_near_misses(
    result: StudyResult,
) -> None:
    table = abilities(result)

    assert table.columns[1:] == (
        *("Overtaking", "Merging", "Emergency Brake", "Give Way", "Traffic Signs"),
        "mean",
    )
    assert table.rows[0][-1].reason.startswith("no route for Merging")
    table = near_misses(result)
    assert len(table.rows) == len(result.drives)
    slow = {row[0].text: row for row in table.rows}["slow, ideal"]
    assert slow[4].text != MISSING
    assert slow[4].detail


def test_one_variant_is_not_compared(result: StudyResult) -> None:
    study = replace(result.study, variants=result.study.variants[1:2], baseline="slow")
    drives = tuple(drive for drive in result.drives if drive.variant == "slow")
    alone = replace(result, study=study, variants=result.variants[1:2], drives=drives)

    labels = [row[0].text for row in scoreboard(alone).rows]
    assert labels == ["slow, ideal", "slow, slow"]
    assert "Difference" not in "".join(table.title for table in alone.tables())


# Markup is text in every page and drawing of a report.


MARKUP = "<script>alert(1)</script>"


def test_everything_in_a_page_is_escaped() -> None:
    row, rows = (MARKUP, MARKUP), [(MARKUP, MARKUP, MARKUP)]
    table = Table(MARKUP, row, ((Cell(MARKUP, MARKUP), Cell("", "", MARKUP)),), MARKUP)
    drawing = Drawing(Markup("<svg>"), MARKUP)
    sections = [Section(MARKUP, (table,), (drawing,)), Section(MARKUP, (table,))]
    made = [row], rows, [row], MARKUP, [MARKUP]

    page = Page(MARKUP, MARKUP, sections, *made, drawing).html()

    assert "<script" not in page
    assert page.count("&lt;script&gt;") > 25


def test_words_in_a_drawing_are_text() -> None:
    figure, axes = plt.subplots()
    axes.set_title(MARKUP)
    axes.plot([1], [1], label=MARKUP)
    axes.legend()
    try:
        drawn = svg(figure)
    finally:
        plt.close(figure)
    assert "<script" not in drawn


def test_the_line_of_the_docs_reads_a_folder_of_records(
    result: StudyResult, folder: Path
) -> None:
    pandas = pytest.importorskip("pandas")
    text = Path("docs/study.md").read_text("utf-8")
    (line,) = re.findall(r"^    (pandas\.concat.*)$", text, re.MULTILINE)

    names = {"pandas": pandas, "Path": Path}
    rows = eval(line.replace("OUT/", f"{folder}/"), names)

    means = rows.groupby(level=0).driving_score.mean().to_dict()
    assert means == {
        drive.name: pytest.approx(drive.scores.driving_score.value)
        for drive in result.drives
        if drive.scores is not None
    }
