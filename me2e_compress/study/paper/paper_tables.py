"""The paper's tables, from what was driven.

Its own figures stand beside them, in columns of their own: they are of other stacks, on
other roads, with other traffic.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from me2e_compress.driving.realtime import DT_US, skipped_decisions
from me2e_compress.metrics.measure import Measure
from me2e_compress.study.drive_record import PERCENTS
from me2e_compress.study.paper import published
from me2e_compress.study.paper.energy_columns import EER, ENERGY, EnergyColumns
from me2e_compress.study.paper.paper_counts import partners, table_4
from me2e_compress.study.paper.published import PublishedDrive
from me2e_compress.study.paper.route_columns import COLUMNS, DS, mean_of, paired
from me2e_compress.study.tables import MISSING, estimate_cell, measure_cell
from me2e_compress.study.workload import held_frames
from me2e_compress.workflows.result import Cell, Table

if TYPE_CHECKING:
    from me2e_compress.study.paper.paper_result import PaperResult
    from me2e_compress.study.study_blocks import StudyBlock

SCORES = tuple(each.name for each in COLUMNS)
GIVEN = ("paper's DS", "paper's DE %", "paper's DC")
GIVEN_ENERGY = ("paper's J/frame", "paper's EER")
OURS = (
    "Means with their 95 % intervals over these scenario types. The paper's figures"
    " are of UniAD in CARLA, which drives on after a collision; here a route ends at"
    " the first. Compare directions, not numbers."
)


def all_paper_tables(result: "PaperResult") -> tuple[Table, ...]:
    """Return every table that the study has a block for, and the collisions."""
    makers = {
        "table-2": table_2,
        "table-3": table_3,
        "table-5": table_5,
        "table-6": table_6,
        "tail": tail,
    }
    found = [
        makers[block.name](result, block)
        for block in result.study.blocks
        if block.name in makers
    ]
    found.append(table_4(result))
    found.sort(key=lambda table: table.title)
    return (*found, partners(result))


def table_2(result: "PaperResult", block: "StudyBlock") -> Table:
    """Show one driver at the paper's rates, and at latencies of its own."""
    study, name = result.study, block.variants[0]
    conditions = [each for each in study.conditions if each.name in block.conditions]
    held = {held_frames(study, each): each.name for each in reversed(conditions)}
    rows = []
    for given in published.RATES:
        frames = skipped_decisions(round(1e6 / given.fps)) + 1
        condition = held.get(frames, "")
        rows.append(
            (
                Cell(f"{given.fps:g}"),
                Cell(condition or MISSING),
                *_rate(frames),
                *_scores(result, name, condition),
                *_given(given),
            )
        )
    own = published.RATES_RT["UniAD"]
    for each in conditions:
        if each.traced or each.mean_of:
            rows.append(
                (
                    Cell("own" if each.traced else "own mean"),
                    Cell(each.name),
                    *_rate(held_frames(study, each)),
                    *_scores(result, name, each.name),
                    *_given(own if each.traced else None),
                )
            )
    return Table(
        f"Table 2: {name} at rates of decisions{result.preview}",
        ("FPS", "driven as", "n", "decisions a second", *SCORES, *GIVEN),
        tuple(rows),
        "n of equation 4 at a step of 50 ms: decisions skipped; the new control acts"
        " n + 1 frames later, so the rate in the world is 20 / (n + 1). Rates of one n"
        " are one condition, driven once: 14 to 30 FPS are the same drive, and what"
        " the paper finds between 20 and 30 cannot be found by its own equation."
        f" {OURS}",
        words=2,
    )


def table_3(result: "PaperResult", block: "StudyBlock") -> Table:
    """Show the driver without modules, each at its own latency."""
    condition = block.conditions[0]
    base = result.fact("exact")
    energy = EnergyColumns.of(result, block.variants, condition)
    rows = []
    for name in block.variants:
        fact = result.fact(name)
        whole = name in (result.study.baseline, base.variant)
        given = published.MODULES_AWAY.get(name)
        rows.append(
            (
                Cell(name),
                Cell("") if whole else _less(base.parameters, fact.parameters, 1e6),
                Cell("") if whole else _less(base.macs, fact.macs, 1e9),
                _plain(fact.fps, ".2f", fact.failure or "not measured"),
                *_scores(result, name, condition),
                _against(result, name, result.study.baseline, condition),
                *energy.cells(name),
                *_given(given),
                *_given_energy(given),
            )
        )
    return Table(
        f"Table 3: modules away, under {condition}{result.preview}",
        (
            "scheme",
            "M parameters away",
            "GMACs away",
            "FPS",
            *SCORES,
            "DS to baseline",
            *ENERGY,
            *GIVEN,
            *GIVEN_ENERGY,
        ),
        tuple(rows),
        "FPS at the mean latency on the device imagined. Away: less than in exact,"
        " the whole graph after the exact passes. The paper's UniAD has a track module"
        f" that it never takes away, its seg is the map here. {EER} {OURS}",
        result.study.baseline,
    )


def table_5(result: "PaperResult", block: "StudyBlock") -> Table:
    """Show int8 by module, under each condition."""
    base = block.variants[0]
    rows = []
    for condition in block.conditions:
        energy = EnergyColumns.of(result, block.variants, condition)
        for name in block.variants:
            fact, given = result.fact(name), published.INT8.get(name)
            rows.append(
                (
                    Cell(name),
                    Cell(condition),
                    _plain(fact.fps, ".2f", fact.failure or "not measured"),
                    *_scores(result, name, condition),
                    _against(result, name, base, condition),
                    *energy.cells(name),
                    *_given(given),
                    *_given_energy(given),
                )
            )
    return Table(
        f"Table 5: int8 by module{result.preview}",
        (
            *("scheme", "condition", "FPS", *SCORES, f"DS to {base}"),
            *(*ENERGY, *GIVEN, *GIVEN_ENERGY),
        ),
        tuple(rows),
        f"{base} is the paper's Hardware_op: the graph optimized, nothing in int8. At"
        " the paper's 22 to 31 FPS equation 4 skips nothing, as where decisions cost"
        f" no time; on the slow device int8 pays by being earlier. {EER} {OURS}",
        words=2,
    )


def table_6(result: "PaperResult", block: "StudyBlock") -> Table:
    """Show the driver with its rate limited."""
    study, name = result.study, block.variants[0]
    held = {
        held_frames(study, each): each.name
        for each in reversed(study.conditions)
        if each.name in block.conditions
    }
    rows = []
    for given in published.LIMITED:
        frames = skipped_decisions(round(1e6 / given.fps)) + 1
        condition = held.get(frames, "")
        fact = result.fact(name)
        joules = None if fact.joules is None else fact.joules[0]
        modelled = fact.modelled_j
        rows.append(
            (
                Cell(f"{given.fps:g}"),
                Cell(condition or MISSING),
                *_rate(frames),
                *_scores(result, name, condition),
                Cell(MISSING, reason="power at a limited rate is not measured"),
                _plain(_times(joules, given.fps), ".3g", fact.no_joules),
                _plain(_times(modelled, given.fps), ".3g", "not counted"),
                *_given(given),
                Cell("" if given.watts is None else f"{given.watts:.0f}"),
            )
        )
    return Table(
        f"Table 6: {name} with its rate limited{result.preview}",
        (
            *("FPS", "driven as", "n", "decisions a second"),
            *(*SCORES, "W", "J/frame x FPS", "modelled J x FPS", *GIVEN, "paper's W"),
        ),
        tuple(rows),
        "A faster model waits: latency = max(its own, 1 / FPS). E x FPS is the paper's"
        " own formula, not a measurement: its watts at 4 FPS are 34.6 J a frame, those"
        f" at 22 are 27.9. {OURS}",
        words=2,
    )


def tail(result: "PaperResult", block: "StudyBlock") -> Table:
    """Show a stage that is called in critical frames, and its mean at every one."""
    base = result.study.baseline
    rows = [
        (
            Cell(name),
            Cell(condition),
            *_latency(result, name, condition),
            *_scores(result, name, condition),
            _against(result, name, base, condition),
        )
        for condition in block.conditions
        for name in block.variants
    ]
    return Table(
        f"The long tail{result.preview}",
        ("variant", "condition", "mean ms", "worst p99 ms", *SCORES, f"DS to {base}"),
        tuple(rows),
        "optimizer is the driver with UniAD's collision optimisation, which runs on the"
        " host where its occupancy says that something is near. tail charges each"
        " call's iterations; even charges every decision what that costs on average."
        " Milliseconds are what decisions were charged; the worst p99 is of a route.",
        words=2,
    )


def _latency(result: "PaperResult", name: str, condition: str) -> tuple[Cell, Cell]:
    cell = result.cell(name, condition)
    mean_us = None if cell is None else cell.mean_latency_us
    if cell is None or mean_us is None:
        reason = result.why_not(name, condition)
        return Cell(MISSING, reason=reason), Cell(MISSING, reason=reason)
    ends = [
        each.latency_us[PERCENTS.index(99)] for each in cell.routes if each.decisions
    ]
    return Cell(f"{mean_us / 1e3:.0f}"), Cell(f"{max(ends) / 1e3:.0f}")


def _scores(result: "PaperResult", name: str, condition: str) -> Iterable[Cell]:
    cell = result.cell(name, condition)
    if cell is None:
        reason = result.why_not(name, condition)
        return [Cell(MISSING, reason=reason) for _ in COLUMNS]
    seed = result.study.seed
    return [estimate_cell(mean_of(cell, each, seed)) for each in COLUMNS]


def _against(result: "PaperResult", name: str, other: str, condition: str) -> Cell:
    one, reference = result.cell(name, condition), result.cell(other, condition)
    if name == other:
        return Cell("")
    if one is None or reference is None:
        missing = name if one is None else other
        return Cell(MISSING, reason=result.why_not(missing, condition))
    return estimate_cell(paired(one, reference, DS, result.study.seed), signed=True)


def _given(row: PublishedDrive | None) -> tuple[Cell, ...]:
    if row is None:
        return (Cell(""),) * 3
    return Cell(f"{row.ds:.2f}"), Cell(f"{row.de:.2f}"), Cell(f"{row.dc:.2f}")


def _rate(frames: int) -> tuple[Cell, Cell]:
    return Cell(str(frames - 1)), Cell(f"{1e6 / (frames * DT_US):.3g}")


def _less(whole: int | None, left: int | None, unit: float) -> Cell:
    if whole is None or left is None:
        return Cell(MISSING, reason="not counted")
    return Cell(f"{(whole - left) / unit:.3f}")


def _plain(value: float | None, form: str, why: str) -> Cell:
    reason = "" if value is not None else why
    return measure_cell(Measure(value, "", reason), form)


def _given_energy(row: PublishedDrive | None) -> tuple[Cell, Cell]:
    if row is None:
        return Cell(""), Cell("")
    texts = ("" if each is None else f"{each:.2f}" for each in (row.joules, row.eer))
    joules, score = map(Cell, texts)
    return joules, score


def _times(joules: float | None, fps: float) -> float | None:
    return None if joules is None else joules * fps
