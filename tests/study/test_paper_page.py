"""Tables, figures and page of the paper's study, from drives that nobody drove."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from me2e_compress.errors import StudyError
from me2e_compress.registry.marks import is_marked
from me2e_compress.study.paper.paper_drives import Int8Counts, ModelFacts
from me2e_compress.study.paper.paper_figures import safety
from me2e_compress.study.paper.paper_findings import Verdict
from me2e_compress.study.paper.paper_result import PaperResult, paper_page
from me2e_compress.study.paper.weigh import weighed
from me2e_compress.study.report.style import styled, svg
from me2e_compress.study.write import write_study


@pytest.fixture(scope="module")
def page(result: PaperResult) -> str:
    return paper_page(result, ("me2e-compress", "study", "paper")).html()


def test_all_files_say_that_we_wrote_them(result: PaperResult, tmp_path: Path) -> None:
    for _ in range(2):
        written = write_study(result, tmp_path)
        assert all(map(is_marked, vars(written).values()))


def test_rates_that_equation_4_makes_one_are_one_drive(result: PaperResult) -> None:
    table = next(each for each in result.tables() if each.title.startswith("Table 2"))
    rows = {row[0].text: [cell.text for cell in row] for row in table.rows}

    assert rows["14"][1:8] == rows["30"][1:8]
    assert rows["14"][1:4] == ["ideal", "0", "20"]
    assert rows["8"][1:4] == ["fps-10", "1", "10"]
    assert rows["3"][1:4] == ["fps-3", "5", "3.33"]
    assert rows["24"][10:] == ["40.63", "138.21", "0.33"]


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
    for each in result.findings:
        assert each.verdict.value in page


def test_a_study_without_drives_has_a_page_too(result: PaperResult) -> None:
    empty = replace(result, drives=(), facts=())

    page = paper_page(empty).html()

    assert "<svg" not in page
    assert {each.verdict for each in empty.findings} == {Verdict.NOT_TESTED}
    assert "float under ideal: not driven" in page


def test_the_same_records_give_the_same_figure(result: PaperResult) -> None:
    one, two = safety(result), safety(result)

    assert one is not None
    assert two is not None
    with styled():
        assert svg(one) == svg(two)
