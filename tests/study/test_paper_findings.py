"""Tables, findings and page of the paper's study, from drives that nobody drove."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress.errors import StudyError
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.registry.marks import is_marked
from me2e_compress.study import load_study
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.paper.paper_drives import Int8Counts, ModelFacts
from me2e_compress.study.paper.paper_figures import safety
from me2e_compress.study.paper.paper_result import PaperResult, paper_page
from me2e_compress.study.paper.paper_run import read_paper
from me2e_compress.study.paper.questions import (
    Rule,
    Verdict,
    falls,
    not_lower_by,
    rises,
    within,
)
from me2e_compress.study.paper.weigh import weighed
from me2e_compress.study.report.style import styled, svg
from me2e_compress.study.write import write_study
from tests.study.paper_records import write_records

YES, NO, OPEN = Verdict.CONFIRMED, Verdict.OPPOSITE, Verdict.NOT_CONFIRMED


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> PaperResult:
    folder = tmp_path_factory.mktemp("records")
    write_records(load_study("paper", "11"), folder)
    return read_paper(load_study("paper"), folder)


@pytest.fixture(scope="module")
def page(result: PaperResult) -> str:
    return paper_page(result, ("me2e-compress", "study", "paper")).html()


def test_all_files_say_that_we_wrote_them(result: PaperResult, tmp_path: Path) -> None:
    for _ in range(2):
        written = write_study(result, tmp_path)
        assert all(map(is_marked, vars(written).values()))


Cells = dict[tuple[str, str], DriveRecord]


def cells_of(result: PaperResult) -> Cells:
    return {(each.variant, each.condition): each for each in result.finished}


def with_cells(result: PaperResult, cells: Cells) -> PaperResult:
    drives = (
        replace(each, variant=variant, condition=condition)
        for (variant, condition), each in cells.items()
    )
    return replace(result, drives=tuple(drives))


def verdicts(result: PaperResult) -> dict[str, Verdict]:
    return {each.asked.question: each.verdict for each in result.findings}


@pytest.mark.parametrize(
    ("rule", "low", "high", "verdict"),
    [
        (rises, 0.1, 2.0, YES),
        (rises, -1.0, 2.0, OPEN),
        (rises, -2.0, -0.1, NO),
        (rises, 0.0, 0.0, OPEN),
        (falls, -2.0, -0.1, YES),
        (falls, 0.1, 2.0, NO),
        (falls, None, None, OPEN),
        (not_lower_by(3.0), -2.9, -0.1, YES),
        (not_lower_by(3.0), -3.1, 1.0, OPEN),
        (not_lower_by(3.0), -5.0, -3.1, NO),
        (within(1.0), -0.9, 0.9, YES),
        (within(1.0), -1.1, 0.9, OPEN),
        (within(1.0), 1.1, 3.0, NO),
        (within(1.0), None, None, OPEN),
    ],
)
def test_a_verdict_follows_from_the_interval(
    rule: Rule, low: float | None, high: float | None, verdict: Verdict
) -> None:
    assert rule(Estimate(Measure(1.0, "points"), low, high, 9)) is verdict


def test_findings_follow_from_the_drives(result: PaperResult) -> None:
    found = verdicts(result)

    assert found["More decisions a second drive better, up to 20"] is YES
    assert found["Comfort falls as the rate rises"] is NO
    assert found["Without the map it drives no worse"] is NO
    assert found["Int8 in the whole network costs driving score"] is YES


def test_other_drives_turn_a_finding_round(result: PaperResult) -> None:
    slow, ideal = result.drive("float", "fps-1"), result.drive("float", "ideal")
    turned = {**cells_of(result), ("float", "fps-1"): ideal, ("float", "ideal"): slow}

    found = verdicts(with_cells(result, turned))

    assert found["More decisions a second drive better, up to 20"] is NO
    assert found["Comfort falls as the rate rises"] is YES


@pytest.mark.parametrize(
    ("where", "drive"), [("slow device", "device-tail"), ("10 decisions", "tail")]
)
def test_what_spikes_cost_is_told_of_the_speed_that_it_is_asked_of(
    result: PaperResult, where: str, drive: str
) -> None:
    key = "optimizer", drive
    record = result.drive(*key)
    worse = tuple(replace(each, driving_score=0.0) for each in record.routes)
    cells = {**cells_of(result), key: replace(record, routes=worse)}

    before, after = verdicts(result), verdicts(with_cells(result, cells))

    changed = [each for each in after if after[each] is not before[each]]
    assert len(changed) == 3
    assert all(f"({where}" in each and after[each] is YES for each in changed)


def test_what_was_not_driven_is_not_tested_and_says_so(result: PaperResult) -> None:
    cells = {
        key: each for key, each in cells_of(result).items() if key[0] != "minus-occ"
    }
    failed = DriveRecord("minus-occ", "device", reason="no memory")
    lacking = with_cells(result, cells)
    lacking = replace(lacking, drives=(*lacking.drives, failed))

    found = {each.asked.question: each for each in lacking.findings}
    finding = found["Without occupancy it drives better"]

    assert finding.verdict is Verdict.NOT_TESTED
    assert finding.estimate.measure == Measure(None, "points", "no memory")


def test_a_drive_without_collisions_has_no_shares(result: PaperResult) -> None:
    key = "float", "device"
    record = result.drive(*key)
    safe = tuple(replace(each, infractions=()) for each in record.routes)
    cells = {**cells_of(result), key: replace(record, routes=safe)}

    found = {e.asked.question: e for e in with_cells(result, cells).findings}
    [answer] = [each for name, each in found.items() if "static things" in name]

    why = "a drive without a collision has no shares"
    assert answer.estimate.measure.reason == why


def test_rates_that_equation_4_makes_one_are_one_drive(result: PaperResult) -> None:
    table = next(each for each in result.tables() if each.title.startswith("Table 2"))
    rows = {row[0].text: [cell.text for cell in row] for row in table.rows}

    assert rows["14"][1:8] == rows["30"][1:8]
    assert rows["14"][1:4] == ["ideal", "0", "20"]
    assert rows["8"][1:4] == ["fps-10", "1", "10"]
    assert rows["3"][1:4] == ["fps-3", "5", "3.33"]
    assert rows["24"][8:] == ["40.63", "138.21", "0.33"]


def test_modelled_energy_stands_apart_from_measured(result: PaperResult) -> None:
    table = next(each for each in result.tables() if each.title.startswith("Table 5"))
    at = {name: table.columns.index(name) for name in table.columns}
    row = table.rows[0]

    assert row[at["J/frame"]].reason == "not measured"
    assert row[at["EER_AV"]].reason == "energy: not measured"
    assert row[at["modelled mJ/frame"]].text == "4"
    assert row[at["EER_AV, modelled"]].detail


def test_measured_joules_are_scored_and_multiplied(result: PaperResult) -> None:
    facts = tuple(replace(each, joules=(2.0, 1.9, 2.1)) for each in result.facts)
    tables = {
        each.title.split(":")[0]: each for each in replace(result, facts=facts).tables()
    }

    five, six = tables["Table 5"], tables["Table 6"]

    assert five.rows[0][five.columns.index("J/frame")].text == "2"
    assert five.rows[0][five.columns.index("EER_AV")].detail
    assert six.rows[1][six.columns.index("J/frame x FPS")].text == "20"
    assert six.rows[1][six.columns.index("W")].reason


def test_what_is_int8_is_counted_beside_the_papers_counts(
    result: PaperResult, tmp_path: Path
) -> None:
    vad = ModelFacts(
        "vad-tiny full", size_bytes=59_612_069, int8=Int8Counts(162, 180, 164)
    )
    table = next(
        each
        for each in replace(result, facts=(*result.facts, vad)).tables()
        if each.title.startswith("Table 4")
    )
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in table.rows}

    assert rows["feature-ext"][:3] == ["30", "31", "31"]
    assert rows["feature-ext"][4:] == ["UniAD", "365", "281", "138", "257.17"]
    ours, given = ["162", "180", "164", "59.61"], ["VAD", "194", "155", "77", "83.32"]
    assert rows["vad-tiny full"] == [*ours, *given]
    with pytest.raises(StudyError, match=r"none of exact, prediction, .* as \.onnx$"):
        weighed(tmp_path)


def test_shares_of_collisions_add_up(result: PaperResult) -> None:
    table = result.tables()[-1]

    for row in table.rows:
        if row[2].text != "0":
            assert sum(int(cell.detail) for cell in row[3:]) == int(row[2].text)


def test_a_preview_is_named_so_everywhere(result: PaperResult, page: str) -> None:
    assert all("(preview: 11 of 220 routes)" in each.title for each in result.tables())
    titles = re.findall(r"<(?:title|h1|figcaption)>(.*?)<", page)
    assert len(titles) >= 8
    assert all("preview: 11 of 220 routes" in each for each in titles)


def test_the_page_holds_tables_figures_and_findings(
    result: PaperResult, page: str
) -> None:
    assert page.count("<svg") == 3
    assert "Figure 5a" in page
    assert "Figure 7" in page
    assert "one condition" in page
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", page)
    for finding in result.findings:
        assert finding.verdict.value in page


def test_a_study_without_drives_has_a_page_too(result: PaperResult) -> None:
    empty = replace(result, drives=(), facts=())

    page = paper_page(empty).html()

    assert "<svg" not in page
    assert set(verdicts(empty).values()) == {Verdict.NOT_TESTED}
    assert "float under ideal: not driven" in page


def test_the_same_records_give_the_same_figure(result: PaperResult) -> None:
    one, two = safety(result), safety(result)

    assert one is not None
    assert two is not None
    with styled():
        assert svg(one) == svg(two)


def test_a_record_is_read_as_it_was_written(
    result: PaperResult, tmp_path: Path
) -> None:
    record = result.drive("minus-map", "device")
    path = tmp_path / "one.jsonl"
    record.save(path)

    assert DriveRecord.load(path) == record
