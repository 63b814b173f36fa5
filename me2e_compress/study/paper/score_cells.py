"""Table cells that the paper's tables share."""

from collections.abc import Iterable

from me2e_compress.driving.realtime import DT_US
from me2e_compress.metrics.measure import Measure
from me2e_compress.study.paper.paper_drives import PaperDrives
from me2e_compress.study.paper.published import PublishedDrive
from me2e_compress.study.route_columns import COLUMNS, DS, mean_of, paired
from me2e_compress.study.tables import MISSING, estimate_cell, measure_cell
from me2e_compress.workflows.result import Cell

SCORES = tuple(each.name for each in COLUMNS)
GIVEN = ("paper's DS", "paper's DE %", "paper's DC")
GIVEN_ENERGY = ("paper's J/frame", "paper's EER")


def score_cells(result: PaperDrives, name: str, condition: str) -> Iterable[Cell]:
    """Show the four scores of a drive, or why there are none."""
    cell = result.cell(name, condition)
    if cell is None:
        reason = result.why_not(name, condition)
        return [Cell(MISSING, reason=reason) for _ in COLUMNS]
    seed = result.study.seed
    return [estimate_cell(mean_of(cell, each, seed)) for each in COLUMNS]


def against(result: PaperDrives, name: str, other: str, condition: str) -> Cell:
    """Show the driving score of one minus another, over the same routes."""
    one, reference = result.cell(name, condition), result.cell(other, condition)
    if name == other:
        return Cell("")
    if one is None or reference is None:
        missing = name if one is None else other
        return Cell(MISSING, reason=result.why_not(missing, condition))
    return estimate_cell(paired(one, reference, DS, result.study.seed), signed=True)


def given_cells(row: PublishedDrive | None) -> tuple[Cell, ...]:
    """Show the paper's three scores."""
    if row is None:
        return (Cell(""),) * 3
    return Cell(f"{row.ds:.2f}"), Cell(f"{row.de:.2f}"), Cell(f"{row.dc:.2f}")


def rate_cells(frames: int) -> tuple[Cell, Cell]:
    """Show n of equation 4 and the resulting decisions per second."""
    return Cell(str(frames - 1)), Cell(f"{1e6 / (frames * DT_US):.3g}")


def less_cell(whole: int | None, left: int | None, unit: float) -> Cell:
    """Show the reduction from one size to another."""
    if whole is None or left is None:
        return Cell(MISSING, reason="not counted")
    return Cell(f"{(whole - left) / unit:.3f}")


def plain_cell(value: float | None, form: str, why: str) -> Cell:
    """Show a number, or a dash with its reason."""
    reason = "" if value is not None else why
    return measure_cell(Measure(value, "", reason), form)


def given_energy(row: PublishedDrive | None) -> tuple[Cell, Cell]:
    """Show the paper's joules per frame and EER_AV."""
    if row is None:
        return Cell(""), Cell("")
    texts = ("" if each is None else f"{each:.2f}" for each in (row.joules, row.eer))
    joules, score = map(Cell, texts)
    return joules, score


def times(joules: float | None, fps: float) -> float | None:
    """Multiply joules per frame by frames per second."""
    return None if joules is None else joules * fps
