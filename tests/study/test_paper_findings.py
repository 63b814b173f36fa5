"""Findings of the paper's study, from drives that nobody drove."""

from dataclasses import replace

import pytest

from me2e_compress.metrics.infraction import InfractionKind
from me2e_compress.metrics.measure import Measure
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.paper.paper_findings import Finding, Verdict
from me2e_compress.study.paper.paper_result import PaperResult

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


def test_comfort_has_a_verdict_in_each_arithmetic(result: PaperResult) -> None:
    found = finding(result, "rate-comfort-b2d")

    assert finding(result, "rate-comfort").verdict is NO
    assert found.verdict is YES
    assert found.found.estimate.value == pytest.approx(-0.25)
    assert found.found.estimate.anew_low is not None


def test_early_records_have_no_verdict_in_bench2drives(result: PaperResult) -> None:
    cells = {
        name: replace(
            drive,
            routes=tuple(
                replace(e, bench2drive_efficiency=None, bench2drive_smoothness=None)
                for e in drive.routes
            ),
        )
        for name, drive in cells_of(result).items()
    }
    early = with_cells(result, cells)

    found = finding(early, "rate-efficiency-b2d")
    assert found.verdict is Verdict.NOT_TESTED
    assert found.found.estimate.measure.reason == "no route has a DE b2d %"
    # room was not recorded in either
    assert [each.name for each in early.columns] == ["DS", "SR %", "DE %", "DC"]
    assert {"DE b2d %", "DC b2d"} < {each.name for each in result.columns}


def test_other_drives_turn_a_finding_round(result: PaperResult) -> None:
    slow, ideal = result.drive("float", "fps-1"), result.drive("float", "ideal")
    turned = {**cells_of(result), ("float", "fps-1"): ideal, ("float", "ideal"): slow}

    found = verdicts(with_cells(result, turned))

    assert found["rate-20"] is NO
    assert found["rate-comfort"] is YES


@pytest.mark.parametrize(
    ("drive", "names"),
    [
        ("device-tail", {"spikes-slow", "no-stage-even-slow", "no-stage-slow"}),
        ("tail", {"spikes", "no-stage"}),
    ],
)
def test_what_spikes_cost_is_told_of_the_speed_that_it_is_asked_of(
    result: PaperResult, drive: str, names: set[str]
) -> None:
    key = "optimizer", drive
    record = result.drive(*key)
    worse = tuple(replace(each, driving_score=0.0) for each in record.routes)
    cells = {**cells_of(result), key: replace(record, routes=worse)}

    before, after = verdicts(result), verdicts(with_cells(result, cells))

    assert {each for each in after if after[each] is not before[each]} == names
    assert all(after[each] is YES for each in names)


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


def test_shares_of_too_few_collisions_are_not_compared(result: PaperResult) -> None:
    wall = ((InfractionKind.COLLISION_LAYOUT.value, 5_000_000, "wall"),)
    base = result.drive("float", "device")

    def hitting(with_map: int, without: int) -> Finding:
        """Answer where so many routes end at a wall, and all others at a car."""
        cells = cells_of(result)
        for name, walls in (("float", with_map), ("minus-map", without)):
            routes = tuple(
                replace(each, infractions=wall if at < walls else CAR)
                for at, each in enumerate(base.routes)
            )
            cells[name, "device"] = replace(base, variant=name, routes=routes)
        return finding(with_cells(result, cells), "map-static")

    few, enough = hitting(1, 3), hitting(0, len(base.routes))

    why = "too few to compare: 3 of 11 and 1 of 11 collisions are with static things"
    assert few.verdict is Verdict.NOT_TESTED
    assert few.found.estimate.measure.reason == why
    assert enough.found.estimate.value == 1.0


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


def test_two_claims_on_one_difference_are_one_test(result: PaperResult) -> None:
    one, other = finding(result, "map"), finding(result, "map-vad")

    assert one.p == other.p
    assert {one.verdict, other.verdict} == {YES, NO}


def test_a_question_of_a_tail_needs_one(result: PaperResult) -> None:
    facts = [replace(e, latency_us=(*e.latency_us, 10**6)) for e in result.facts]

    without, there = (
        finding(result, "tail"),
        finding(replace(result, facts=tuple(facts)), "tail"),
    )

    assert "there is no tail" in without.found.estimate.measure.reason
    assert there.verdict is not Verdict.NOT_TESTED


def test_latencies_of_one_run_decide_nothing(result: PaperResult) -> None:
    assert finding(result, "int8-saves").verdict is Verdict.NOT_TESTED


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


def test_normalizations_that_disagree_give_no_verdict(result: PaperResult) -> None:
    found = finding(result, "eer-feature-ext")
    sides = {found.question.judge(value, p)[0] for value, p in found.found.ways}

    assert len(found.found.ways) == 4
    if len(sides) > 1:
        assert found.verdict is Verdict.NOT_SHOWN


def test_routes_without_a_measure_are_named(result: PaperResult) -> None:
    key = "exact", "device"
    record = result.drive(*key)
    still = tuple(
        replace(each, efficiency=each.efficiency if at else None)
        for at, each in enumerate(record.routes)
    )
    cells = {**cells_of(result), key: replace(record, routes=still)}

    found = finding(with_cells(result, cells), "eer-feature-ext")

    total = len(record.routes)
    assert f"{total - 1} of {total} routes: 1 have no efficiency" in found.found.notes


def test_drives_that_differ_in_their_charge_alone_are_one(result: PaperResult) -> None:
    cells = cells_of(result)
    same = tuple(
        replace(each, latency_us=(1,) * 4, latency_sum_us=1)
        for each in cells["float", "fps-10"].routes
    )
    found = with_cells(
        result, {("float", "fps-10"): cells["float", "fps-10"],
                 ("float", "even"): replace(cells["float", "even"], routes=same),
                 ("float", "fps-1"): cells["float", "fps-1"]}
    )  # fmt: skip

    assert found.distinct == 2
    assert "3 of 41 drives, 2 of them distinct" in found.headline
