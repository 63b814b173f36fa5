"""Joules per frame and EER_AV of drives, measured and modelled separately."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self

import numpy as np

from me2e_compress.metrics.eer import eer, rankings
from me2e_compress.metrics.efficiency import CHECKPOINTS
from me2e_compress.metrics.episode import Ending
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.metrics.route_measures import RouteMeasures
from me2e_compress.study.drive_record import DriveRecord, RouteSummary
from me2e_compress.study.tables import estimate_cell, measure_cell
from me2e_compress.workflows.result import Cell

if TYPE_CHECKING:
    from me2e_compress.study.paper.paper_result import PaperResult

Energy = Literal["measured", "modelled"]
"""Source of the joules per frame."""
ENERGY = ("J/frame", "EER_AV", "modelled mJ/frame", "EER_AV, modelled")
EER = (
    "EER_AV (equations 8 to 11) in points, by CRITIC weights over the rows of one"
    " condition, min-max over their routes: scores of other tables or conditions are"
    " not comparable. J/frame is measured by a counter; modelled figures are published"
    " energies of MACs and bytes, and only say how the variants compare."
)


@dataclass(frozen=True)
class EnergyColumns:
    """Energy of variants that drove under one condition, with both EER_AV."""

    joules: Mapping[str, Estimate]
    modelled_mj: Mapping[str, Measure]
    scores: Mapping[str, Estimate]
    modelled_scores: Mapping[str, Estimate]

    @classmethod
    def of(cls, result: "PaperResult", variants: Sequence[str], condition: str) -> Self:
        """Score the variants that drove; the others get reasons."""
        facts = {name: result.fact(name) for name in variants}
        measured = joules_by_variant(result, variants, "measured")
        modelled = joules_by_variant(result, variants, "modelled")
        return cls(
            {
                name: _joules(fact.joules, fact.failure or fact.no_joules)
                for name, fact in facts.items()
            },
            {name: _milli(joules) for name, joules in modelled.items()},
            _scores(result, measured, condition),
            _scores(result, modelled, condition),
        )

    def cells(self, name: str) -> tuple[Cell, ...]:
        """Show a variant's four columns."""
        return (
            estimate_cell(self.joules[name], ".3g"),
            estimate_cell(self.scores[name]),
            measure_cell(self.modelled_mj[name], ".3g"),
            estimate_cell(self.modelled_scores[name]),
        )


def joules_by_variant(
    result: "PaperResult", variants: Sequence[str], energy: Energy
) -> dict[str, float | None]:
    """Return joules per frame of one kind; None if unknown."""
    facts = {name: result.fact(name) for name in variants}
    if energy == "modelled":
        return {name: fact.modelled_j for name, fact in facts.items()}
    return {
        name: None if fact.joules is None else fact.joules[0]
        for name, fact in facts.items()
    }


def measures_by_variant(
    result: "PaperResult", joules: Mapping[str, float | None], condition: str
) -> dict[str, RouteMeasures]:
    """Return the measures of the variants that drove under a condition."""
    return {
        name: record_measures(cell, each)
        for name, each in joules.items()
        if (cell := result.cell(name, condition)) is not None
    }


def ranking_note(result: "PaperResult", variants: Sequence[str], condition: str) -> str:
    """Say how the variants rank, and whether that depends on the normalization."""
    energy: Energy = "measured"
    if all(result.fact(name).joules is None for name in variants):
        energy = "modelled"
    joules = joules_by_variant(result, variants, energy)
    found = rankings(measures_by_variant(result, joules, condition))
    orders = dict[tuple[str, ...], list[str]]()
    for normalization, order in found.items():
        orders.setdefault(order, []).append(normalization.value)
    if not orders:
        return ""
    parts = [f"{' > '.join(order)} ({', '.join(by)})" for order, by in orders.items()]
    return f"EER_AV, {energy} energy, under {condition}, ranks {'; '.join(parts)}."


def record_measures(record: DriveRecord, j_per_frame: float | None) -> RouteMeasures:
    """Return the four measures of each route, as `route_measures` does of episodes."""
    routes = record.routes
    joules = [_route_joules(each, j_per_frame) for each in routes]
    return RouteMeasures(
        np.array([each.driving_score for each in routes], np.float64),
        np.array([_efficiency(each) for each in routes], np.float64),
        np.array([_comfort(each) for each in routes], np.float64),
        np.array(joules, np.float64),
        np.array([bool(each.collisions) for each in routes], np.bool_),
    )


def _scores(
    result: "PaperResult", joules: Mapping[str, float | None], condition: str
) -> dict[str, Estimate]:
    driven = measures_by_variant(result, joules, condition)
    found = dict(eer(driven, seed=result.study.seed).scores)
    for name in joules:
        why = result.why_not(name, condition)
        found.setdefault(name, Estimate(Measure(None, "points", why), None, None, 0))
    return found


def _efficiency(route: RouteSummary) -> float:
    if route.efficiency is not None:
        return route.efficiency
    begun = route.completion >= 100.0 / CHECKPOINTS
    return math.nan if begun or not _recorded(route) else 0.0


def _comfort(route: RouteSummary) -> float:
    if route.comfort is not None:
        return route.comfort
    return 0.0 if _recorded(route) else math.nan


def _route_joules(route: RouteSummary, j_per_frame: float | None) -> float:
    if j_per_frame is None or not (route.decisions or _failed(route)):
        return math.nan
    return j_per_frame * route.decisions


def _recorded(route: RouteSummary) -> bool:
    return bool(route.duration_us or _failed(route))


def _failed(route: RouteSummary) -> bool:
    return route.ending == Ending.POLICY_FAILED.value


def _joules(found: tuple[float, float, float] | None, why: str) -> Estimate:
    if found is None:
        return Estimate(Measure(None, "J", why or "not measured"), None, None, 0)
    return Estimate(Measure(found[0], "J"), found[1], found[2], 0)


def _milli(joules: float | None) -> Measure:
    if joules is None:
        return Measure(None, "mJ", "not counted")
    return Measure(1e3 * joules, "mJ")
