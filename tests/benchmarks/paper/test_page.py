"""Tables, figures and page of the paper's study, from drives that nobody drove."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.paper.drives import Int8Counts, ModelFacts
from benchmarks.paper.result import PaperResult, paper_page
from benchmarks.paper.weigh import weighed
from me2e_compress.errors import StudyError


@pytest.fixture(scope="module")
def page(result: PaperResult) -> str:
    return paper_page(result, "python -m benchmarks.paper").html()


def test_rates_that_equation_4_makes_one_are_one_drive(result: PaperResult) -> None:
    table = next(each for each in result.tables() if each.title.startswith("Table 2"))
    rows = {row[0].text: [cell.text for cell in row] for row in table.rows}

    assert rows["14"][1:8] == rows["30"][1:8]
    assert rows["14"][1:4] == ["ideal", "0", "20"]
    assert rows["8"][1:4] == ["fps-10", "1", "10"]
    assert rows["3"][1:4] == ["fps-3", "5", "3.33"]
    assert rows["24"][10:] == ["40.63", "138.21", "0.33"]


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
