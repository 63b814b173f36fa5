"""The paper's findings as questions, and the tests that answer them here.

No answer is written down: every verdict follows from the drives.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from me2e_compress.metrics.eer import eer
from me2e_compress.metrics.infraction import InfractionKind
from me2e_compress.metrics.intervals import intervals, mean_estimate
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.paper.energy_columns import (
    Energy,
    joules_by_variant,
    measures_by_variant,
)
from me2e_compress.study.paper.route_columns import (
    DS,
    RouteColumn,
    gaps,
    mean_gap,
    mean_of,
    paired,
)
from me2e_compress.study.tables import MISSING, estimate_cell
from me2e_compress.workflows.result import Cell, Table

if TYPE_CHECKING:
    from me2e_compress.study.paper.paper_result import PaperResult


class Verdict(StrEnum):
    """What the interval says about a finding."""

    CONFIRMED = "confirmed"
    NOT_CONFIRMED = "not confirmed"
    OPPOSITE = "opposite"
    NOT_TESTED = "not tested"


@dataclass(frozen=True)
class Finding:
    """A question about a finding of the paper, and the answer.

    The question is phrased so that the paper's answer is yes; ``paper`` and ``test``
    say in words what the paper found and what is computed here.
    """

    question: str
    paper: str
    test: str
    verdict: Verdict
    estimate: Estimate | None = None
    reason: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return all fields."""
        return {
            "question": self.question,
            "paper": self.paper,
            "test": self.test,
            "verdict": self.verdict.value,
            "estimate": None if self.estimate is None else self.estimate.to_json(),
            "reason": self.reason or None,
        }


class UntestedError(Exception):
    """Data that a test needs are missing; the message names them."""


Rule = Callable[[Estimate], Verdict]
CellName = tuple[str, str]


def rises(found: Estimate) -> Verdict:
    """Judge whether a difference is above zero."""
    return _beyond(found, 0.0, 0.0)


def falls(found: Estimate) -> Verdict:
    """Judge whether a difference is below zero."""
    turned = {
        Verdict.CONFIRMED: Verdict.OPPOSITE,
        Verdict.OPPOSITE: Verdict.CONFIRMED,
    }
    verdict = rises(found)
    return turned.get(verdict, verdict)


def not_lower_by(margin: float) -> Rule:
    """Return a rule that a difference is not below minus a margin."""
    return lambda found: _beyond(found, -margin, -margin)


def within(margin: float) -> Rule:
    """Return a rule that a difference is no larger than a margin, up or down."""

    def judge(found: Estimate) -> Verdict:
        if found.low is None or found.high is None:
            return Verdict.NOT_CONFIRMED
        if -margin <= found.low and found.high <= margin:
            return Verdict.CONFIRMED
        outside = found.low > margin or found.high < -margin
        return Verdict.OPPOSITE if outside else Verdict.NOT_CONFIRMED

    return judge


def _beyond(found: Estimate, least: float, most: float) -> Verdict:
    """Judge by the position of the whole interval."""
    if found.low is not None and found.low > least:
        return Verdict.CONFIRMED
    if found.high is not None and found.high < most:
        return Verdict.OPPOSITE
    return Verdict.NOT_CONFIRMED


@dataclass(frozen=True)
class Evidence:
    """The drives of a study, with the statistics that tests need."""

    result: "PaperResult"

    @property
    def seed(self) -> int:
        """Seed of bootstraps."""
        return self.result.study.seed

    def cell(self, name: CellName) -> DriveRecord:
        """Return a drive, or raise an `UntestedError` that says why it is missing."""
        found = self.result.cell(*name)
        if found is None:
            raise UntestedError(self.result.why_not(*name))
        return found

    def mean(self, name: CellName, column: RouteColumn) -> float:
        """Return a mean over the routes of a drive."""
        found = mean_of(self.cell(name), column, self.seed)
        if found.value is None:
            raise UntestedError(found.measure.reason)
        return found.value

    def difference(
        self, one: CellName, other: CellName, column: RouteColumn = DS
    ) -> Estimate:
        """Return the mean of one minus the other over the same routes."""
        return paired(self.cell(one), self.cell(other), column, self.seed)

    def change_of_change(
        self, first: CellName, middle: CellName, last: CellName
    ) -> Estimate:
        """Return how much more DS changes from first to middle than to last."""
        early = gaps(self.cell(middle), self.cell(first), DS)
        late = gaps(self.cell(last), self.cell(middle), DS)
        both = {name: gap - late[name] for name, gap in early.items() if name in late}
        return mean_gap(both, self.cell(middle), DS, self.seed, of=2)

    def static_share(self, one: CellName, other: CellName) -> Estimate:
        """Return the increase of the share of collisions with static objects."""
        drives = self.cell(one), self.cell(other)
        counts = np.array([_static_and_all(drive) for drive in drives], np.float64)
        if not counts[:, :, 1].sum(axis=1).all():
            raise UntestedError("a drive without a collision has no shares")

        def gap(weights: np.ndarray[Any, np.dtype[np.float64]]) -> Any:
            static, every = (weights @ counts[:, :, at].T for at in (0, 1))
            shares = static / np.maximum(every, 1e-9)
            return shares[:, 0] - shares[:, 1]

        value = float(gap(np.ones((1, counts.shape[1])))[0])
        types = [each.scenario for each in drives[0].routes]
        here, anew = intervals(gap, types, self.seed, value, (-1.0, 1.0))
        measure = Measure(value, "ratio")
        return Estimate(measure, *here, len(types), *anew)

    def eer_gap(self, one: str, other: str, condition: str, energy: Energy) -> Estimate:
        """Return the difference in EER_AV, scored with all of table 5."""
        block = next((b for b in self.result.study.blocks if b.name == "table-5"), None)
        if block is None:
            raise UntestedError("the study has no block table-5")
        joules = joules_by_variant(self.result, block.variants, energy)
        found = eer(measures_by_variant(self.result, joules, condition))
        for name in (one, other):
            if name not in found.routes:
                score = found.scores.get(name)
                why = self.result.why_not(name, condition)
                raise UntestedError(why if score is None else score.measure.reason)
        gaps_by_route = (found.routes[one] - found.routes[other]).tolist()
        if any(found.left_out.values()):
            types = [""] * len(gaps_by_route)
        else:
            types = [each.scenario for each in self.cell((one, condition)).routes]
        return mean_estimate(gaps_by_route, types, "points", self.seed)

    def faster_by(self, one: str, other: str) -> Estimate:
        """Return by how many ms the median latency of one is below the other's."""
        samples = [self.result.fact(name).latency_us for name in (one, other)]
        if not all(samples):
            raise UntestedError(f"no latencies of {one} and {other}")
        random = np.random.default_rng(self.seed)
        drawn = [
            np.median(random.choice(each, (2_000, len(each))), axis=1)
            for each in samples
        ]
        low, high = np.percentile(drawn[1] - drawn[0], (2.5, 97.5)) / 1e3
        value = float(np.median(samples[1]) - np.median(samples[0])) / 1e3
        return Estimate(Measure(value, "ms"), float(low), float(high), len(samples[0]))


def _static_and_all(drive: DriveRecord) -> list[tuple[int, int]]:
    kinds = [[kind for kind, _ in each.collisions] for each in drive.routes]
    return [(each.count(InfractionKind.COLLISION_LAYOUT), len(each)) for each in kinds]


@dataclass(frozen=True)
class PaperQuestion:
    """A finding of the paper before it is tested; ``rule`` may read the drives."""

    question: str
    paper: str
    test: str
    compute: Callable[[Evidence], Estimate]
    rule: Callable[[Evidence], Rule] = lambda evidence: rises

    def answer(self, result: "PaperResult") -> Finding:
        """Compute and judge."""
        evidence = Evidence(result)
        try:
            found = self.compute(evidence)
            if found.value is None:
                raise UntestedError(found.measure.reason)
            verdict = self.rule(evidence)(found)
        except UntestedError as error:
            words = self.question, self.paper, self.test
            return Finding(*words, Verdict.NOT_TESTED, reason=str(error))
        return Finding(self.question, self.paper, self.test, verdict, found)


def findings_table(found: tuple[Finding, ...], preview: str) -> Table:
    """Show every question with its verdict and interval."""
    # an untested finding has a reason instead of a difference
    rows = [
        (
            Cell(each.question),
            Cell(each.paper),
            Cell(each.test if each.estimate else each.reason),
            Cell(each.verdict.value),
            Cell(MISSING, reason=each.reason)
            if each.estimate is None
            else _shown(each.estimate),
        )
        for each in found
    ]
    tested = sum(each.estimate is not None for each in found)
    return Table(
        f"The paper's findings{preview}",
        ("is it so that", "the paper", "the test", "here", "difference"),
        tuple(rows),
        "Confirmed: the whole 95 % interval of the difference lies on the paper's"
        " side; opposite: on the other; not confirmed: it holds both. Differences are"
        " paired by route. Each interval is stated for itself: of"
        f" {tested} tests at 95 % about {0.05 * tested:.0f} would miss by chance.",
        words=4,
    )


def _shown(estimate: Estimate) -> Cell:
    form = ".1f" if estimate.measure.unit != "ratio" else ".3f"
    cell = estimate_cell(estimate, form, signed=True)
    return Cell(f"{cell.text} {estimate.measure.unit}", cell.detail, cell.reason)
