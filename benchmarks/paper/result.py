"""Results of the paper's study so far, and their page."""

import functools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.figure import Figure

from benchmarks.paper import figures
from benchmarks.paper.accident import plans_before
from benchmarks.paper.drives import PaperDrives
from benchmarks.paper.findings import (
    Finding,
    Verdict,
    findings,
    findings_table,
    told_of_questions,
)
from benchmarks.paper.tables import all_paper_tables
from me2e_compress.base.display import Table
from me2e_compress.study.report.figures import styled, svg
from me2e_compress.study.report.page import Drawing, Page, Section


@dataclass(frozen=True)
class PaperResult(PaperDrives):
    """The drives in the paper's tables, with its findings as questions."""

    @property
    def headline(self) -> str:
        """Title, and number of drives."""
        study = self.study
        wanted = sum(len(study.driven_under(each)) for each in study.conditions)
        return (
            f"{self.title}: {len(self.finished)} of {wanted} drives,"
            f" {self.distinct} of them distinct"
        )

    @functools.cached_property
    def findings(self) -> tuple[Finding, ...]:
        """The paper's findings as questions, answered by these drives."""
        return findings(self)

    @property
    def verdicts(self) -> str:
        """How many findings have which verdict."""
        found = Counter(each.verdict for each in self.findings)
        counts = ", ".join(f"{found[e]} {e.value}" for e in Verdict if found[e])
        return f"Of its {len(self.findings)} findings {counts}."

    def tables(self) -> tuple[Table, ...]:
        """Return the findings, then the paper's tables in its order."""
        return findings_table(self, self.findings), *all_paper_tables(self)

    def lines(self) -> tuple[str, ...]:
        """Return how many drives there are, and which questions were asked."""
        return self.headline, told_of_questions(self, self.findings)


def _figure_6(result: PaperResult) -> Figure | None:
    return None if result.accident is None else plans_before(result.accident)


FIGURES: dict[str, tuple[tuple[Callable[[PaperResult], Figure | None], str], ...]] = {
    "Table 2": (
        (
            figures.safety,
            "Figure 5a. Rates of one n of equation 4 are one drive: 14 to 30 FPS, grey,"
            " and 8 and 10. Right, the paper's own figures.",
        ),
        (figures.efficiency_and_comfort, "Figure 5b."),
    ),
    "Table 3": (
        (
            figures.where_the_time_goes,
            "Figure 7. Left, the modules of the whole driver, inference by inference;"
            " right, the longest tails: the share of decisions that take longer.",
        ),
    ),
    "Collisions by partner": (
        (
            _figure_6,
            "Figure 6. One driver's successive plans before its own accident, the later"
            " the darker: filled boxes are the ego, dotted ones who was near.",
        ),
    ),
}


def paper_page(result: PaperResult, command: str = "") -> Page:
    """Return the page of the questions, their answers, figures and tables."""
    findings, *tables = result.tables()
    return Page(
        result.title,
        f"{result.verdicts} {result.headline}.",
        [Section("Findings", (findings,)), *(_section(e, result) for e in tables)],
        [
            ("Command", command),
            ("Machine", result.machine),
            ("Device", f"{result.device_scale:.3g} times slower, for all alike"),
            ("Seed", str(result.study.seed)),
        ],
        [
            (each.variant, each.pipeline or each.failure or "as it is", each.sha256)
            for each in result.facts
        ],
        [(each.verdict.value, f"{each.question.asks}.") for each in result.findings],
    )


def _section(table: Table, result: PaperResult) -> Section:
    """Return a table under its name, with the figures that have drives."""
    preview = result.study.preview
    heading = table.title.removesuffix(preview).partition(":")[0]
    with styled():  # the same figure gives the same names in its SVG
        drawn = [
            Drawing(svg(figure), f"{note}{preview}")
            for draw, note in FIGURES.get(heading, ())
            if (figure := draw(result)) is not None
        ]
    return Section(heading, (table,), drawings=tuple(drawn))
