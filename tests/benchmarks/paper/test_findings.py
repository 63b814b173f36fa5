"""Findings of the paper's study, from drives that nobody drove."""

from dataclasses import replace

import pytest

from benchmarks.paper.findings import Finding, Verdict
from benchmarks.paper.result import PaperResult
from me2e_compress.metrics.infraction import InfractionKind
from me2e_compress.metrics.measure import Measure
from me2e_compress.study.drive_record import DriveRecord

CAR = ((InfractionKind.COLLISION_VEHICLE.value, 5_000_000, "car 3"),)
YES, NO = Verdict.SAME, Verdict.OTHER
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
    return {each.question.name: each.verdict for each in result.findings}


def finding(result: PaperResult, name: str) -> Finding:
    return next(each for each in result.findings if each.question.name == name)


def test_findings_follow_from_the_drives(result: PaperResult) -> None:
    found = verdicts(result)

    assert found["rate-20"] is YES
    assert found["rate-comfort"] is NO
    assert found["map"] is NO
    assert found["map-vad"] is YES
    assert found["int8-full"] is YES


def test_what_was_not_driven_is_not_tested_and_says_so(result: PaperResult) -> None:
    cells = {
        key: each for key, each in cells_of(result).items() if key[0] != "minus-occ"
    }
    failed = DriveRecord("minus-occ", "device", reason="no memory")
    lacking = with_cells(result, cells)
    lacking = replace(lacking, drives=(*lacking.drives, failed))

    found = finding(lacking, "occ")

    assert (found.verdict, found.p) == (Verdict.NOT_TESTED, None)
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
                assert each.verdict is Verdict.NOT_SHOWN


def test_a_question_of_a_tail_needs_one(result: PaperResult) -> None:
    facts = [replace(e, latency_us=(*e.latency_us, 10**6)) for e in result.facts]

    without, there = (
        finding(result, "tail"),
        finding(replace(result, facts=tuple(facts)), "tail"),
    )

    assert "there is no tail" in without.found.estimate.measure.reason
    assert there.verdict is not Verdict.NOT_TESTED


@pytest.mark.parametrize(
    ("runs", "verdict"),
    [
        ({"prediction": (400, 401, 399, 402, 400), "feature-ext": (370, 372) * 3}, YES),
        ({"prediction": (400, 360, 430, 350, 390), "feature-ext": (385,) * 5},
         Verdict.NOT_SHOWN),
        ({"prediction": (400,) * 4, "feature-ext": (370,) * 5}, Verdict.NOT_TESTED),
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
    key, base = ("minus-motion", "device"), result.drive("float", "device")
    lost = replace(
        result.drive(*key),
        routes=tuple(
            replace(e, driving_score=e.driving_score - 1.0 - 0.1 * (at % 3))
            for at, e in enumerate(base.routes)
        ),
    )
    slightly = with_cells(result, {**cells_of(result), key: lost})

    clear = finding(at_latency(slightly, key[0], 424_000), "motion")
    near = finding(at_latency(slightly, key[0], 395_000), "motion")

    assert clear.verdict is YES
    assert near.verdict is Verdict.NOT_SHOWN
    assert "a step of equation 4 is at 400" in near.found.notes[0]
