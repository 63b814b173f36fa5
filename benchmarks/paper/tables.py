"""The paper's tables, from the drives made here.

The paper's own figures are of other stacks, roads and traffic: they have columns of
their own.
"""

from collections.abc import Iterator, Sequence

from benchmarks.paper import published
from benchmarks.paper.cells import (
    EER,
    ENERGY,
    GIVEN,
    GIVEN_ENERGY,
    against,
    energy_cells,
    given_cells,
    held_at,
    plain_cell,
    ranking_note,
    rate_cells,
    score_cells,
    times,
)
from benchmarks.paper.counts import partners, table_4
from benchmarks.paper.drives import PaperDrives
from benchmarks.paper.periods import frames_per_decision
from benchmarks.paper.published import PublishedDrive
from me2e_compress.base.display import Cell, Table
from me2e_compress.metrics.route_summary import PERCENTS
from me2e_compress.study.cells import MISSING
from me2e_compress.study.definition import StudyBlock

OURS = (
    "Means with their 95 % intervals over these scenario types. The paper's figures"
    " are of UniAD in CARLA, which drives on after a collision; here a route ends at"
    " the first. Compare directions, not numbers. room: room kept to others, which DS"
    " does not see; b2d: in the arithmetic of Bench2Drive's tools, which the earliest"
    " records lack."
)


RATE = ("FPS", "driven as", "n", "decisions a second")


def all_paper_tables(result: PaperDrives) -> tuple[Table, ...]:
    """Return every table that the study has a block for, and the collisions."""
    makers = {
        "table-2": table_2,
        "table-3": table_3,
        "table-5": table_5,
        "table-6": table_6,
        "tail": tail,
    }
    blocks = [each for each in result.study.blocks if each.name in makers]
    found = [table_4(result), *(makers[each.name](result, each) for each in blocks)]
    return (*sorted(found, key=lambda table: table.title), partners(result))


def table_2(result: PaperDrives, block: StudyBlock) -> Table:
    """Show one driver at the paper's rates, and at latencies of its own."""
    # the paper's rates
    study, name = result.study, block.variants[0]
    rows = [
        (*cells, *given_cells(given))
        for given, cells in _at_rates(result, block, published.RATES)
    ]
    # the driver's own latencies
    own = published.RATES_RT["UniAD"]
    rows += [
        (
            Cell("own" if each.traced else "own mean"),
            Cell(each.name),
            *rate_cells(frames_per_decision(study, each)),
            *score_cells(result, name, each.name),
            *given_cells(own if each.traced else None),
        )
        for each in study.conditions
        if each.name in block.conditions and (each.traced or each.mean_of)
    ]
    return Table(
        f"Table 2: {name} at rates of decisions{result.study.preview}",
        (*RATE, *_scores(result), *GIVEN),
        tuple(rows),
        "n of equation 4 at a step of 50 ms: decisions skipped; the new control acts"
        " n + 1 frames later, so the rate in the world is 20 / (n + 1). Rates of one n"
        " are one condition, driven once: 14 to 30 FPS are the same drive, and what"
        " the paper finds between 20 and 30 cannot be found by its own equation."
        f" {OURS}",
        words=2,
    )


def table_3(result: PaperDrives, block: StudyBlock) -> Table:
    """Show the driver without some modules, each variant at its own latency."""
    # all variants drive under one condition
    condition = block.conditions[0]
    base, exact = result.study.baseline, result.fact("exact")
    energy = energy_cells(result, block.variants, condition)
    rows = []
    for name in block.variants:
        # sizes are relative to the whole graph
        fact, given = result.fact(name), published.MODULES_AWAY.get(name)
        whole = name in (base, exact.variant)
        parameters = _less(exact.parameters, fact.parameters, 1e6)
        macs = _less(exact.macs, fact.macs, 1e9)
        rows.append(
            (
                Cell(name),
                *([Cell("")] * 2 if whole else [parameters, macs]),
                *_scored(result, name, condition, base),
                *energy[name],
                *given_cells(given, energy=True),
            )
        )
    return Table(
        f"Table 3: modules away, under {condition}{result.study.preview}",
        (
            "scheme",
            "M parameters away",
            "GMACs away",
            "FPS",
            *_scores(result),
            *("DS to baseline", "room to baseline"),
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


def table_5(result: PaperDrives, block: StudyBlock) -> Table:
    """Show int8 by module, under each condition."""
    # the first variant is the float graph
    base = block.variants[0]
    rankings = [ranking_note(result, block.variants, each) for each in block.conditions]
    rows = []
    for condition in block.conditions:
        energy = energy_cells(result, block.variants, condition)
        rows += [
            (
                Cell(name),
                Cell(condition),
                *_scored(result, name, condition, base),
                *energy[name],
                *given_cells(published.INT8.get(name), energy=True),
            )
            for name in block.variants
        ]
    return Table(
        f"Table 5: int8 by module{result.study.preview}",
        (
            *("scheme", "condition", "FPS", *_scores(result)),
            *(f"DS to {base}", f"room to {base}"),
            *(*ENERGY, *GIVEN, *GIVEN_ENERGY),
        ),
        tuple(rows),
        f"{base} is the paper's Hardware_op: the graph optimized, nothing in int8. At"
        " the paper's 22 to 31 FPS equation 4 skips nothing. Here all drive at 10"
        " decisions a second, which tells what int8 itself costs; on the slow device"
        " int8 pays by being earlier."
        f" {' '.join(filter(None, (*rankings, EER, OURS)))}",
        words=2,
    )


def table_6(result: PaperDrives, block: StudyBlock) -> Table:
    """Show the driver with its rate limited."""
    # watts are not measured here
    name = block.variants[0]
    fact = result.fact(name)
    joules = None if fact.joules is None else fact.joules[0]
    rows = [
        (
            *cells,
            Cell(MISSING, reason="power at a limited rate is not measured"),
            plain_cell(times(joules, given.fps), ".3g", fact.no_joules),
            plain_cell(times(fact.modelled_j, given.fps), ".3g", "not counted"),
            *given_cells(given),
            Cell("" if given.watts is None else f"{given.watts:.0f}"),
        )
        for given, cells in _at_rates(result, block, published.LIMITED)
    ]
    return Table(
        f"Table 6: {name} with its rate limited{result.study.preview}",
        (
            *RATE,
            *_scores(result),
            "W",
            "J/frame x FPS",
            "modelled J x FPS",
            *GIVEN,
            "paper's W",
        ),
        tuple(rows),
        "A faster model waits: latency = max(its own, 1 / FPS). E x FPS is the paper's"
        " own formula, not a measurement: its watts at 4 FPS are 34.6 J a frame, those"
        f" at 22 are 27.9. {OURS}",
        words=2,
    )


def tail(result: PaperDrives, block: StudyBlock) -> Table:
    """Compare a host stage in critical frames with its mean at every frame."""
    # one row per variant and condition
    base = result.study.baseline
    rows = [
        (
            Cell(name),
            Cell(condition),
            *_latency(result, name, condition),
            *score_cells(result, name, condition),
            *against(result, name, base, condition),
        )
        for condition in block.conditions
        for name in block.variants
    ]
    return Table(
        f"The long tail{result.study.preview}",
        (
            *("variant", "condition", "mean ms", "slowest ms", "decisions a second"),
            *(*_scores(result), f"DS to {base}", f"room to {base}"),
        ),
        tuple(rows),
        "optimizer is the driver with UniAD's collision optimisation, which runs on the"
        " host where its occupancy says that something is near. tail charges each"
        " call's iterations beside 100 ms, device-tail beside what the model takes on"
        " the slow device; even charges every decision what that costs on average."
        " Milliseconds are what decisions were charged; slowest is the slowest of all."
        " Equation 4 drops what is beyond a whole step, so equal means are not equal"
        " rates in the world.",
        words=2,
    )


def _scores(result: PaperDrives) -> tuple[str, ...]:
    return tuple(each.name for each in result.columns)


def _at_rates(
    result: PaperDrives, block: StudyBlock, rates: Sequence[PublishedDrive]
) -> Iterator[tuple[PublishedDrive, list[Cell]]]:
    """Yield the paper's rates, each with the scores of its condition here."""
    # the condition of each number of held frames
    study, name = result.study, block.variants[0]
    held = {
        frames_per_decision(study, each): each.name
        for each in reversed(study.conditions)
        if each.name in block.conditions
    }
    for given in rates:
        frames = held_at(given.fps)
        condition = held.get(frames, "")
        driven = [Cell(f"{given.fps:g}"), Cell(condition or MISSING)]
        scores = score_cells(result, name, condition)
        yield given, [*driven, *rate_cells(frames), *scores]


def _scored(
    result: PaperDrives, name: str, condition: str, base: str
) -> tuple[Cell, ...]:
    """Show inferences a second, scores, and the driving score against another's."""
    fact = result.fact(name)
    return (
        plain_cell(fact.fps, ".2f", fact.failure or "not measured"),
        *score_cells(result, name, condition),
        *against(result, name, base, condition),
    )


def _less(whole: int | None, left: int | None, unit: float) -> Cell:
    """Show the reduction from one size to another."""
    if whole is None or left is None:
        return Cell(MISSING, reason="not counted")
    return Cell(f"{(whole - left) / unit:.3f}")


def _latency(result: PaperDrives, name: str, condition: str) -> tuple[Cell, Cell, Cell]:
    drive = result.drive(name, condition)
    mean_us = drive.mean_latency_us
    if mean_us is None:
        missing = Cell(MISSING, reason=drive.reason or "no decision was taken")
        return missing, missing, missing
    slowest = PERCENTS.index(100)
    ends = [each.latency_us[slowest] for each in drive.routes if each.decisions]
    decisions = sum(each.decisions for each in drive.routes)
    time_us = sum(each.duration_us for each in drive.routes)
    return (
        Cell(f"{mean_us / 1e3:.0f}"),
        Cell(f"{max(ends) / 1e3:.0f}"),
        Cell(f"{1e6 * decisions / max(time_us, 1):.2f}"),
    )
