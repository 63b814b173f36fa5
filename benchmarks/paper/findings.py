"""Answers to the paper's questions; none is written down, all follow from drives."""

from dataclasses import dataclass, replace
from enum import StrEnum

from benchmarks.paper.drives import PaperDrives
from benchmarks.paper.evidence import Found, evidence
from benchmarks.paper.questions import BEFORE, PaperQuestion, PaperQuestions
from me2e_compress.base.display import Cell, Table
from me2e_compress.metrics.route_summary import holm
from me2e_compress.study.cells import MISSING, estimate_cell

FIRST = "first form"
"""Of a question whose drives do not know it, and that nobody changed."""


class Verdict(StrEnum):
    """What the drives say about a finding; they say nothing of other roads."""

    SAME = "same direction here"
    NOT_SHOWN = "not shown here"
    OTHER = "other direction here"
    NOT_TESTED = "not tested"


@dataclass(frozen=True)
class Finding:
    """The answer to a question, and the estimate that it follows from.

    Attributes:
        p: Two-sided p-value, corrected for all questions of the page; None if nothing
            was tested.
        asked: How the question stood before its drives.
    """

    question: PaperQuestion
    verdict: Verdict
    found: Found
    p: float | None
    asked: str


def findings(result: PaperDrives) -> tuple[Finding, ...]:
    """Answer every question; the p-values are corrected by Holm over all tested.

    Two claims about one difference are one test, with the larger of their p-values.
    """
    asked = PaperQuestions.load(result.questions)
    found = [evidence(each, result, asked.step) for each in asked.question]
    judged = [_judged(*each) for each in zip(asked.question, found, strict=True)]
    largest = dict[object, float]()
    for question, each, (_, raw) in zip(asked.question, found, judged, strict=True):
        if each.ways:
            largest[question.compared] = max(raw, largest.get(question.compared, 0.0))
    corrected = dict(zip(largest, holm(list(largest.values())), strict=True))
    answers = []
    for question, each, (side, _) in zip(asked.question, found, judged, strict=True):
        p = corrected[question.compared] if each.ways else None
        verdict = _verdict(side, p, asked.alpha)
        when = _asked(question, asked, result)
        answers.append(Finding(question, verdict, each, p, when))
    return tuple(answers)


def _judged(question: PaperQuestion, found: Found) -> tuple[int, float]:
    """Return side and p-value on which all ways to compute it agree."""
    judged = [question.judge(value, p_at, found.shift) for value, p_at in found.ways]
    sides = {side for side, _ in judged}
    if len(sides) != 1:
        return 0, 1.0
    return judged[0][0], max(p for _, p in judged)


def _verdict(side: int, p: float | None, alpha: float) -> Verdict:
    if p is None:
        return Verdict.NOT_TESTED
    if p >= alpha or not side:
        return Verdict.NOT_SHOWN
    return Verdict.SAME if side > 0 else Verdict.OTHER


def _asked(question: PaperQuestion, now: PaperQuestions, result: PaperDrives) -> str:
    """Say how a question stood before its drives, by their records if they know it."""
    drives = [result.drive(*each.split(".")) for each in question.drives]
    if question.untested or any(each.reason for each in drives):
        return question.seen
    then = result.asked
    if then is None or any(
        result.asked_of.get(each.name) != then.sha256 for each in drives
    ):
        return question.seen or FIRST
    return then.since(question, now)


def told_of_questions(result: PaperDrives, found: tuple[Finding, ...]) -> str:
    """Say which questions were asked, and whether the drives were made for them."""
    now = PaperQuestions.load(result.questions)
    known = {result.asked_of.get(each.name, "") for each in result.finished}
    said = f"The questions: {now.name}, sha256 {now.sha256}"
    if not known - {""}:
        return (
            f"{said}; the digest of the questions is not in these records. Where"
            f" {FIRST} is said, the question was written before the drives; that whole"
            " types are drawn, and Holm's correction, were decided after."
        )
    if known == {now.sha256}:
        return f"{said}; they were asked before these drives."
    then = ", ".join(sorted(known - {now.sha256, ""}))
    late = [e.question.name for e in found if e.found.ways and e.asked != BEFORE]
    return (
        f"{said}; changed after drives that were made for {then or 'none'}:"
        f" {', '.join(late) or 'what was not driven'}."
    )


def findings_table(result: PaperDrives, found: tuple[Finding, ...]) -> Table:
    """Show every question with its verdict and intervals."""
    tested = len({each.question.compared for each in found if each.p is not None})
    asked = PaperQuestions.load(result.questions)
    return Table(
        f"The paper's findings{result.study.preview}",
        (
            *("is it so that", "the paper", "the test", "here", "difference"),
            *("these types alone", "p, Holm", "asked"),
        ),
        tuple(_row(each) for each in found),
        "The difference, paired by route, stands with its 95 % interval over scenario"
        " types drawn anew (latencies: over runs); that over these types alone stands"
        f" beside. Same direction: p, corrected by Holm over {tested} tests, is below"
        f" {asked.alpha:g}, and the difference on the paper's side of the edge; other"
        " direction: on the other; not shown: neither. highway-env confirms nothing"
        " about CARLA."
        f" {told_of_questions(result, found)}",
        words=4,
    )


def _row(finding: Finding) -> tuple[Cell, ...]:
    question, estimate, p = finding.question, finding.found.estimate, finding.p
    test = estimate.measure.reason or "; ".join((question.test, *finding.found.notes))
    anew = replace(estimate, low=estimate.anew_low, high=estimate.anew_high)
    signed = question.column != "times"
    shown = estimate_cell(anew, signed=signed)
    if not shown.reason:
        shown = Cell(f"{shown.text} {anew.measure.unit}", shown.detail)
    narrow = estimate_cell(estimate, signed=signed).detail
    return (
        Cell(question.asks),
        Cell(question.paper),
        Cell(test),
        Cell(finding.verdict.value),
        shown,
        Cell(narrow or MISSING),
        Cell(MISSING if p is None else f"{p:.2g}" if p < 0.995 else "1"),
        Cell(finding.asked),
    )
