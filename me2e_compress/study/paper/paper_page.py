"""The paper's questions and answers as one HTML page."""

from collections.abc import Callable, Sequence
from typing import TypeAlias

from markupsafe import Markup
from matplotlib.figure import Figure

from me2e_compress.study.paper import paper_figures
from me2e_compress.study.paper.accident_figure import plans_before
from me2e_compress.study.paper.paper_result import PaperResult
from me2e_compress.study.paper.questions import findings_table
from me2e_compress.study.report.page import template
from me2e_compress.study.report.style import styled, svg
from me2e_compress.workflows.result import Table

TEMPLATE = "paper.html"


def _figure_6(result: PaperResult) -> Figure | None:
    return None if result.accident is None else plans_before(result.accident)


Drawn: TypeAlias = tuple[Markup, str]
"""An SVG and its caption."""
FIGURES: dict[str, tuple[tuple[Callable[[PaperResult], Figure | None], str], ...]] = {
    "Table 2": (
        (
            paper_figures.safety,
            "Figure 5a. Rates of one n of equation 4 are one drive: 14 to 30 FPS, grey,"
            " and 8 and 10. Right, the paper's own figures.",
        ),
        (paper_figures.efficiency_and_comfort, "Figure 5b."),
    ),
    "Table 3": (
        (
            paper_figures.where_the_time_goes,
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


def paper_html(result: PaperResult, command: Sequence[str] = ()) -> str:
    """Build the whole page, which is self-contained."""
    return template(TEMPLATE).render(
        title=result.title,
        lede=result.headline,
        findings=result.findings,
        findings_table=findings_table(result.findings, result.preview),
        sections=[_section(table, result) for table in result.tables()[1:]],
        facts=result.facts,
        made=[
            (name, text)
            for name, text in (
                ("Command", " ".join(command)),
                ("Machine", result.machine),
                ("Device", f"{result.device_scale:.3g} times slower, for all alike"),
                ("Seed", str(result.study.seed)),
            )
            if text
        ],
    )


def _section(
    table: Table, result: PaperResult
) -> tuple[str, tuple[Table, ...], tuple[Drawn, ...]]:
    """Return heading, tables and the figures that have drives."""
    heading = table.title.removesuffix(result.preview).partition(":")[0]
    with styled():  # the same figure gives the same names in its SVG
        drawn = [
            (Markup(svg(figure)), f"{note}{result.preview}")
            for draw, note in FIGURES.get(heading, ())
            if (figure := draw(result)) is not None
        ]
    return heading, (table,), tuple(drawn)
