"""Result of a study: every table is a pure function of its records."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any

from me2e_compress.base.display import Cell, Table, plural
from me2e_compress.commands.result import Result, View, json_ready
from me2e_compress.metrics.bench2drive import ABILITIES
from me2e_compress.metrics.measure import unseen_share
from me2e_compress.metrics.route_summary import COLUMNS, PairedDifference, holm
from me2e_compress.runtime.latency_trace import Load
from me2e_compress.runtime.providers import PROVIDERS
from me2e_compress.study.cells import MISSING, estimate_cell, measure_cell, redrawn_cell
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study
from me2e_compress.study.drive_record import Comparison, DriveRecord, compare_pairs
from me2e_compress.study.prepared import PreparedVariant

SCORES = tuple(column.name for column in COLUMNS)
MOST_ROUTES = 40  # with more routes than this, the table of endings is left out
COSTS = ("size MB", "p50 ms", "p99 ms", "plan m", "SQNR dB")
GAPS = ("DS, points", "DS, other types", "room, points", "SR, points")


@dataclass(frozen=True, repr=False)
class StudyResult(Result):
    """All results of a study, and the machine and packages that made them."""

    study: Study
    variants: tuple[PreparedVariant, ...]
    # Condition by condition, the variants in the study's order
    drives: tuple[DriveRecord, ...]
    device_scale: float  # how many times slower the device is than the machine timed on
    machine: str
    versions: Mapping[str, str]  # versions of the packages that decide the result
    # Load by other processes while latencies were measured; None if none was measured
    # here
    load: Load | None = None

    @property
    def title(self) -> str:
        """The study's title, with a note if not all routes were driven."""
        return f"{self.study.title}{self.study.preview}"

    @property
    def timed(self) -> bool:
        """Whether the latency of any variant is known."""
        return any(one.latency_ms[50].value is not None for one in self.variants)

    @property
    def coverage(self) -> tuple[int, int]:
        """Number of routes driven, and of routes in the whole set."""
        if self.study.routes:
            return len(self.study.routes), self.study.set_size
        scores = [drive.scores for drive in self.drives if drive.scores is not None]
        return (scores[0].routes, scores[0].expected) if scores else (0, 0)

    def label(self, drive: DriveRecord) -> str:
        """Name a drive by its variant, and by its condition if there are several."""
        if len(self.study.conditions) == 1:
            return drive.variant
        return f"{drive.variant}, {drive.condition}"

    def described(self, condition: Condition) -> str:
        """Describe a condition, and whose latencies it charges."""
        scale = self.device_scale
        slower = f"a device {scale:.3g} times slower"
        return condition.described("this machine" if scale == 1.0 else slower)

    @cached_property
    def pairs(self) -> tuple[Comparison, ...]:
        """Comparisons of the pairs that the study names."""
        return compare_pairs(self.study.pairs, self.drives, self.study.seed)

    def variant(self, name: str) -> PreparedVariant:
        """Return a variant by its name."""
        return next(variant for variant in self.variants if variant.name == name)

    def view(self) -> View:
        """Return the title with numbers, every table, what failed, a busy machine."""
        study, (driven, whole) = self.study, self.coverage
        headline = (
            f"{study.title}: {plural(len(study.variants), 'variant')} under"
            f" {plural(len(study.conditions), 'condition')} on {driven} of"
            f" {plural(whole, 'route')}"
        )
        # Failures of variants and routes, and a busy machine
        lines = [f"{one.name}: {one.known}" for one in self.variants if one.known]
        alerts = [
            f"variant {variant.name} was left out: {variant.failure}"
            for variant in self.variants
            if variant.failure
        ]
        for drive in self.drives:
            if drive.scores is not None and drive.scores.failed:
                name = f"{drive.variant}, {drive.condition}"
                alerts.append(f"{name}: {drive.scores.failed}")
        if self.load is not None and self.load.busy:
            alerts.append(str(self.load))
        tables = chain.from_iterable(self.tables_by_section.values())
        return View(headline, tables, lines, alerts)

    @cached_property
    def tables_by_section(self) -> Mapping[str, tuple[Table, ...]]:
        """Every table, in reading order; a preview is marked as such."""
        sections = {
            "On the road": (scoreboard(self),),
            "Differences": (difference_table(self),) * (len(self.variants) > 1),
            "Pairs of drives": (pair_table(self),) * bool(self.pairs),
            "Route by route": route_tables(self),
            "Near misses": (near_misses(self),),
            "Abilities": (abilities(self),),
        }
        preview = self.study.preview
        return {
            heading: tuple(replace(e, title=f"{e.title}{preview}") for e in tables)
            for heading, tables in sections.items()
        }

    def to_json(self) -> Any:
        """Return a document: the same bytes of the same seed, but below ``latency``."""
        study, (driven, whole) = self.study, self.coverage
        content = {
            "title": study.title,
            "baseline": study.baseline,
            "seed": study.seed,
            "provider": PROVIDERS.text(study.provider),
            "evaluator": study.evaluator,
            "routes": {"driven": driven, "set": whole},
            "conditions": study.conditions,
            "latency": {
                "device_scale": self.device_scale,
                "samples": study.timing.samples,
                "threads": study.timing.threads,
                **({} if self.load is None else self.load.to_json()),
            },
            "schemes": self.variants,
            "drives": self.drives,
            "pairs": self.pairs,
            "machine": self.machine,
            "versions": self.versions,
        }
        return json_ready(content)


def scoreboard(result: StudyResult) -> Table:
    """Show the scores of every drive, and size and latency of its variant."""
    study, (driven, whole) = result.study, result.coverage
    of = "" if driven == whole else f"{driven} of "
    note = (
        f"{'; '.join(map(result.described, study.conditions))}."
        f" {of}{plural(whole, 'route')}. DS driving score, room kept to others, SR "
        "success rate, DE efficiency, DC comfort, both also in the arithmetic of "
        "Bench2Drive's tools (b2d), each with its 95 % interval over these scenario "
        f"types. {MISSING} means not measured."
    )
    # What the columns of costs are
    if result.timed:
        scale = result.device_scale
        kind = f"times {scale:.3g}, one device scale for all"
        kind = "on this machine" if scale == 1.0 else kind
        note += f" Latency: models in turn, warm, {kind}."
    note += (
        f" Plan and SQNR: how far waypoints move from {study.baseline}'s on held-out"
        " frames, and the noise on them."
    )
    rows = list[tuple[Cell, ...]]()
    for drive in result.drives:
        # A cell for each of `SCORES`
        cells = (Cell(MISSING, reason=drive.reason),) * len(SCORES)
        if (scores := drive.scores) is not None:
            estimates = (
                scores.driving_score,
                scores.safety.room_kept,
                scores.success_rate,
                scores.efficiency,
                scores.bench2drive_efficiency,
                scores.comfort,
                scores.bench2drive_smoothness,
            )
            cells = tuple(map(estimate_cell, estimates))
        # And one for each of `COSTS`
        variant = result.variant(drive.variant)
        latency, fidelity = variant.latency_ms, variant.fidelity
        costs = (
            measure_cell(variant.size_mb, ".2f"),
            measure_cell(latency[50], ".1f"),
            measure_cell(latency[99], ".1f"),
            measure_cell(fidelity.plan_mean, ".3f"),
            measure_cell(fidelity.plan_sqnr, ".1f"),
        )
        rows.append((Cell(result.label(drive)), *cells, *costs))
    columns = ("variant", *SCORES, *COSTS)
    return Table("Scoreboard", columns, tuple(rows), note, study.baseline)


def difference_table(result: StudyResult) -> Table:
    """Show every variant minus the baseline, paired by route."""
    compared = [(drive, gap) for drive in result.drives if (gap := drive.difference)]
    gaps = [gap for _, gap in compared]
    # p-values are corrected for all comparisons shown
    corrected, rows = holm([gap.mcnemar_p for gap in gaps]), list[tuple[Cell, ...]]()
    for (drive, gap), p in zip(compared, corrected, strict=True):
        counts = map(Cell, (f"{p:.2g}", str(gap.routes_better), str(gap.routes_worse)))
        rows.append((Cell(result.label(drive)), *_gap_cells(gap), *counts))
    columns = ("variant", *GAPS, "SR p", "routes better", "routes worse")
    title = f"Difference to {result.study.baseline} on the same routes"
    note = (
        "Mean over routes with its 95 % interval, paired: an interval that holds zero "
        'shows no difference. It is for routes of these scenario types; "DS, other '
        "types\" for types drawn anew. SR p: McNemar's exact test"
    )
    # Several comparisons: the correction, and its limits
    if len(gaps) > 1:
        note += (
            f", corrected for {len(gaps)} comparisons (Holm). Each interval is a 95 % "
            "interval by itself: one in twenty misses zero by chance where nothing "
            "differs"
        )
    note += "."
    # What so few routes cannot show
    if gaps:
        on, least = plural(gaps[0].driving_score.n, "route"), gaps[0].least_detectable
        note += f" {on} cannot show a difference below {least:.1f} points."
    for gap in gaps:
        if not (gap.routes_better or gap.routes_worse):
            routes = gap.driving_score.n
            share = 100.0 * unseen_share(routes)
            note += (
                f" Where 0 of {routes} routes differ, at most {share:.1f} % do (95 %)."
            )
            break
    return Table(title, columns, tuple(rows), note)


def _gap_cells(gap: Comparison | PairedDifference) -> tuple[Cell, ...]:
    """Return one cell for each of `GAPS`."""
    estimates = gap.driving_score, gap.room_kept, gap.success_rate
    score, room, rate = (estimate_cell(estimate, signed=True) for estimate in estimates)
    return score, redrawn_cell(gap.driving_score), room, rate


def abilities(result: StudyResult) -> Table:
    """Show the success rate by ability of every drive."""
    columns = ("variant", *(name.replace("_", " ") for name in ABILITIES), "mean")
    rows = list[tuple[Cell, ...]]()
    for drive in result.drives:
        if (scores := drive.scores) is not None:
            shown = (*scores.each_ability.values(), scores.abilities)
            rows.append((Cell(result.label(drive)), *map(estimate_cell, shown)))
    note = (
        "A route may test two abilities. Intervals are exact, the mean's by bootstrap."
    )
    title, strong = "Success by ability in %", result.study.baseline
    return Table(title, columns, tuple(rows), note, strong)


def pair_table(result: StudyResult) -> Table:
    """Show the pairs of drives that the study names."""
    rows = tuple(
        (Cell(pair.drive), Cell(pair.against), *_gap_cells(pair))
        for pair in result.pairs
    )
    note = (
        "The first drive minus the second, mean over routes with its 95 % interval: one"
        " that holds zero shows no difference."
    )
    title, columns = "Pairs of drives on the same routes", ("drive", "against", *GAPS)
    return Table(title, columns, rows, note)


def route_tables(result: StudyResult) -> tuple[Table, ...]:
    """Show how each route ended for each driver; nothing if there are too many."""
    driven = [drive for drive in result.drives if drive.routes]
    if not driven or len(driven[0].routes) > MOST_ROUTES:
        return ()
    rows = list[tuple[Cell, ...]]()
    for routes in zip(*(drive.routes for drive in driven), strict=True):
        cells = [Cell(routes[0].route)]
        for route in routes:
            room = "" if route.room_kept is None else f"; room {route.room_kept:.0f} %"
            cells.append(Cell(f"{route.driving_score:.1f}", f"{route.fate}{room}"))
        rows.append(tuple(cells))
    columns = ("route", *map(result.label, driven))
    note = "Driving score, why it is not 100, and the room kept to others."
    return (Table("How each route ended", columns, tuple(rows), note),)


def near_misses(result: StudyResult) -> Table:
    """Show how near every drive came to collisions, which end few routes."""
    columns = ("TTC < 1.5 s, %", "least TTC s", "PET s", "distance m", "at fault %")
    rows = list[tuple[Cell, ...]]()
    for drive in result.drives:
        cells = (Cell(MISSING, reason=drive.reason),) * len(columns)
        if drive.scores is not None:
            safety = drive.scores.safety
            least = safety.smallest_ttc, safety.smallest_pet, safety.smallest_distance
            cells = (
                estimate_cell(safety.ttc_exposure),
                *(estimate_cell(smallest, ".2f") for smallest in least),
                estimate_cell(safety.at_fault_collisions),
            )
        rows.append((Cell(result.label(drive)), *cells))
    note = (
        "Means over routes with their 95 % intervals: share of the time with a time to "
        "collision below 1.5 s, the least of a route, post-encroachment time of "
        "crossing paths, smallest distance; and routes with a collision that the ego "
        "could have prevented. Least TTC and PET exist on some routes only."
    )
    heads = ("variant", *columns)
    return Table("Near misses", heads, tuple(rows), note, result.study.baseline)
