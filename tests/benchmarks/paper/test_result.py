"""Findings, tables and page of the paper's study, from drives that nobody drove."""

import re
from dataclasses import replace

import pytest

from benchmarks.paper.__main__ import PAGE
from benchmarks.paper.findings import Finding, Verdict
from benchmarks.paper.records import read_paper
from benchmarks.paper.result import PaperResult, paper_page
from me2e_compress.metrics.measure import Measure
from me2e_compress.study import load_study
from me2e_compress.study.drive_record import DriveRecord
from tests.benchmarks.paper.made import write_records

YES, NOT_SHOWN, NOT_TESTED = Verdict.SAME, Verdict.NOT_SHOWN, Verdict.NOT_TESTED


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> PaperResult:
    """What the paper's study finds in drives that nobody drove."""
    study, folder = PAGE.study, tmp_path_factory.mktemp("records")
    write_records(load_study(study, "11"), folder)
    return read_paper(load_study(study), folder)


def finding(result: PaperResult, name: str) -> Finding:
    return next(each for each in result.findings if each.question.name == name)


def test_what_was_not_driven_is_not_tested_and_says_so(result: PaperResult) -> None:
    drives = [each for each in result.finished if each.variant != "minus-occ"]
    failed = DriveRecord("minus-occ", "device", reason="no memory")

    found = finding(replace(result, drives=(*drives, failed)), "occ")

    assert (found.verdict, found.p) == (NOT_TESTED, None)
    assert found.found.estimate.measure == Measure(None, "points", "no memory")


def test_p_values_are_corrected_over_all_differences_of_the_page(
    result: PaperResult,
) -> None:
    raw = dict[tuple[str, ...], float]()
    for each in result.findings:
        judged = [
            each.question.judge(v, p, each.found.shift) for v, p in each.found.ways
        ]
        agree = len({side for side, _ in judged}) == 1
        if judged:
            compared, p = each.question.compared, max(p for _, p in judged)
            raw[compared] = max(raw.get(compared, 0.0), p if agree else 1.0)

    # Holm by its definition: rejected at p if all smaller ones are, at their own levels
    ordered = sorted(raw.values())
    for each in result.findings:
        if each.p is not None:
            rank = ordered.index(raw[each.question.compared]) + 1
            steps = [p * (len(ordered) - at) for at, p in enumerate(ordered[:rank])]
            assert each.p == pytest.approx(min(1.0, max(steps)))
            if each.p >= 0.05:
                assert each.verdict is NOT_SHOWN


def test_a_question_of_a_tail_needs_one(result: PaperResult) -> None:
    facts = [replace(e, latency_us=(*e.latency_us, 10**6)) for e in result.facts]

    without = finding(result, "tail")
    there = finding(replace(result, facts=tuple(facts)), "tail")

    assert "there is no tail" in without.found.estimate.measure.reason
    assert there.verdict is not NOT_TESTED


@pytest.mark.parametrize(
    ("runs", "verdict"),
    [
        ({"prediction": (400, 401, 399, 402, 400), "feature-ext": (370, 372) * 3}, YES),
        ({"prediction": (400, 360, 430, 350, 390), "feature-ext": (385,) * 5},
         NOT_SHOWN),
        ({"prediction": (400,) * 4, "feature-ext": (370,) * 5}, NOT_TESTED),
    ],
)  # fmt: skip
def test_medians_of_five_separated_runs_decide(
    result: PaperResult, runs: dict[str, tuple[int, ...]], verdict: Verdict
) -> None:
    facts = tuple(
        replace(e, runs_us=tuple(1_000 * t for t in runs.get(e.variant, ())))
        for e in result.facts
    )

    assert finding(replace(result, facts=facts), "int8-saves").verdict is verdict


def at_latency(result: PaperResult, name: str, latency_us: int) -> PaperResult:
    facts = tuple(
        replace(e, latency_us=(latency_us,) * 300) if e.variant == name else e
        for e in result.facts
    )
    return replace(result, facts=facts)


def test_no_verdict_hangs_on_a_step_that_noise_crosses(result: PaperResult) -> None:
    base, own = (result.drive(name, "device") for name in ("float", "minus-motion"))
    lost = replace(
        own,
        routes=tuple(
            replace(e, driving_score=e.driving_score - 1.0 - 0.1 * (at % 3))
            for at, e in enumerate(base.routes)
        ),
    )
    drives = tuple(lost if each == own else each for each in result.finished)
    slightly = replace(result, drives=drives)

    clear = finding(at_latency(slightly, "minus-motion", 424_000), "motion")
    near = finding(at_latency(slightly, "minus-motion", 395_000), "motion")

    assert clear.verdict is YES
    assert near.verdict is NOT_SHOWN
    assert "a step of equation 4 is at 400" in near.found.notes[0]


def test_a_preview_is_named_so_everywhere(result: PaperResult) -> None:
    page = paper_page(result, "python -m benchmarks.paper").html()

    assert all("(preview: 11 of 220 routes)" in each.title for each in result.tables())
    titles = re.findall(r"<(?:title|h1|summary)>((?!All|How).*?)<", page)
    assert len(titles) >= 8
    assert all("preview: 11 of 220 routes" in each for each in titles)
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", page)
    assert page.count("<svg") == 3
    assert all(each.verdict.value in page for each in result.findings)
