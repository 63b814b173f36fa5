"""Cells that the paper's tables share: scores, energy, EER_AV, published figures."""

from collections.abc import Sequence
from typing import Literal

from benchmarks.paper.drives import ModelFacts, PaperDrives
from benchmarks.paper.normalizations import scored
from benchmarks.paper.published import PublishedDrive
from me2e_compress.base.display import Cell
from me2e_compress.driving.realtime import DT_US, skipped_decisions
from me2e_compress.metrics.eer import POINTS, RouteMeasures, eer, route_measures
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.metrics.route_summary import DS, ROOM
from me2e_compress.study.cells import MISSING, estimate_cell, number

GIVEN = ("paper's DS", "paper's DE %", "paper's DC")
GIVEN_ENERGY = ("paper's J/frame", "paper's EER")

Energy = Literal["measured", "modelled"]
"""Source of the joules per frame."""
ENERGY = ("J/frame", "EER_AV", "modelled mJ/frame", "EER_AV, modelled")
EER = (
    "EER_AV (equations 8 to 11) in points, by CRITIC weights over the rows of one"
    " condition, min-max over their routes: scores of other tables or conditions are"
    " not comparable. J/frame is measured by a counter; modelled figures are published"
    " energies of MACs and bytes, and only say how the variants compare."
)


def score_cells(result: PaperDrives, name: str, condition: str) -> list[Cell]:
    """Show the scores of a drive, or why there are none."""
    drive, seed = result.drive(name, condition), result.study.seed
    return [estimate_cell(drive.values(each).mean(seed)) for each in result.columns]


def against(
    result: PaperDrives, name: str, other: str, condition: str
) -> tuple[Cell, Cell]:
    """Show driving score and room of one minus another's, over the same routes."""
    if name == other:
        return Cell(""), Cell("")
    one, reference = (result.drive(each, condition) for each in (name, other))
    score, room = (
        estimate_cell(one.minus(reference, each, result.study.seed), signed=True)
        for each in (DS, ROOM)
    )
    return score, room


def given_cells(row: PublishedDrive | None, *, energy: bool = False) -> list[Cell]:
    """Show the paper's three scores, and its joules per frame and EER_AV."""
    names = ("ds", "de", "dc", "joules", "eer") if energy else ("ds", "de", "dc")
    values = (None if row is None else getattr(row, name) for name in names)
    return [Cell("" if each is None else f"{each:.2f}") for each in values]


def held_at(fps: float) -> int:
    """Return how many frames a decision is held at a rate: n + 1 of equation 4."""
    return skipped_decisions(round(1e6 / fps)) + 1


def rate_cells(frames: int) -> tuple[Cell, Cell]:
    """Show n of equation 4 and the resulting decisions per second."""
    return Cell(str(frames - 1)), Cell(f"{1e6 / (frames * DT_US):.3g}")


def plain_cell(value: float | None, form: str, why: str) -> Cell:
    """Show a number, or a dash with its reason."""
    return Cell(MISSING, reason=why) if value is None else Cell(number(value, form))


def energy_cells(
    result: PaperDrives, variants: Sequence[str], condition: str
) -> dict[str, tuple[Cell, ...]]:
    """Show energy and EER_AV by variant: measured, then modelled."""
    score = _scores(result, variants, "measured", condition)
    modelled_score = _scores(result, variants, "modelled", condition)
    return {
        name: (
            estimate_cell(_joules(result.fact(name)), ".3g"),
            estimate_cell(score[name]),
            plain_cell(times(result.fact(name).modelled_j, 1e3), ".3g", "not counted"),
            estimate_cell(modelled_score[name]),
        )
        for name in variants
    }


def measures_by_variant(
    result: PaperDrives, variants: Sequence[str], energy: Energy, condition: str
) -> dict[str, RouteMeasures]:
    """Return the measures of the variants that drove under a condition."""
    drives = {name: result.drive(name, condition) for name in variants}
    joules = {name: _j_per_frame(result.fact(name), energy) for name in variants}
    return {
        name: route_measures(drive.routes, joules[name])
        for name, drive in drives.items()
        if not drive.reason
    }


def ranking_note(result: PaperDrives, variants: Sequence[str], condition: str) -> str:
    """Say how the variants rank, and whether that depends on the normalization."""
    energy: Energy = "measured"
    if all(result.fact(name).joules is None for name in variants):
        energy = "modelled"
    found = scored(measures_by_variant(result, variants, energy, condition))
    orders = dict[tuple[str, ...], list[str]]()
    for normalization, each in found.items():
        if each.scale is not None:
            orders.setdefault(each.ranking, []).append(normalization.value)
    if not orders:
        return ""
    parts = [f"{' > '.join(order)} ({', '.join(by)})" for order, by in orders.items()]
    return f"EER_AV, {energy} energy, under {condition}, ranks {'; '.join(parts)}."


def _scores(
    result: PaperDrives, variants: Sequence[str], energy: Energy, condition: str
) -> dict[str, Estimate]:
    driven = measures_by_variant(result, variants, energy, condition)
    found = dict(eer(driven, seed=result.study.seed).scores)
    for name in variants:
        if name not in found:
            why = result.drive(name, condition).reason
            found[name] = Estimate.missing(POINTS, why)
    return found


def _j_per_frame(fact: ModelFacts, energy: Energy) -> float | None:
    if energy == "modelled":
        return fact.modelled_j
    return None if fact.joules is None else fact.joules[0]


def _joules(fact: ModelFacts) -> Estimate:
    if fact.joules is None:
        why = fact.failure or fact.no_joules or "not measured"
        return Estimate.missing("J", why)
    mean, low, high = fact.joules
    return Estimate(Measure(mean, "J"), low, high, 0)


def times(joules: float | None, factor: float) -> float | None:
    """Multiply joules per frame by frames per second, or to another unit."""
    return None if joules is None else joules * factor
