"""Result of a study: every table is a pure function of its records."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any

from me2e_compress.display import Cell, Table, plural
from me2e_compress.metrics.bench2drive import ABILITIES
from me2e_compress.metrics.route_summary import COLUMNS, PairedDifference, holm
from me2e_compress.runtime.latency_trace import Load
from me2e_compress.runtime.providers import PROVIDERS
from me2e_compress.study.cells import MISSING, anew_cell, estimate_cell, measure_cell
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study
from me2e_compress.study.drive_record import Comparison, DriveRecord, compared
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.workflows.result import Result, View, plain

SCORES = tuple(each.name for each in COLUMNS)
MOST_ROUTES = 40
"""With more routes than this, the table of endings is left out."""
COSTS = ("size MB", "p50 ms", "p99 ms", "plan m", "SQNR dB")


@dataclass(frozen=True, repr=False)
class StudyResult(Result):
    """All that a study found, and what it was made with.

    Attributes:
        drives: Condition by condition, the variants in the study's order.
        device_scale: How many times slower the device is than the machine timed on.
        versions: Versions of the packages that decide the result.
        load: Load by other processes while latencies were measured; None if none was
            measured here.
    """

    study: Study
    variants: tuple[PreparedVariant, ...]
    drives: tuple[DriveRecord, ...]
    device_scale: float
    machine: str
    versions: Mapping[str, str]
    load: Load | None = None

    @property
    def title(self) -> str:
        """The study's title, with a note if not all routes were driven."""
        return f"{self.study.title}{self.study.preview}"

    @property
    def timed(self) -> bool:
        """Whether the latency of any variant is known."""
        return any(each.latency_ms[50].value is not None for each in self.variants)

    @property
    def coverage(self) -> tuple[int, int]:
        """Number of routes driven, and of routes in the whole set."""
        if self.study.routes:
            return len(self.study.routes), self.study.set_size
        scores = [each.scores for each in self.drives if each.scores is not None]
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
        return compared(self.study.pairs, self.drives, self.study.seed)

    def variant(self, name: str) -> PreparedVariant:
        """Return a variant by its name."""
        return next(each for each in self.variants if each.name == name)

    def view(self) -> View:
        """Return the title with numbers, every table, what failed, a busy machine."""
        study, (driven, whole) = self.study, self.coverage
        alerts = (
            *(
                f"variant {each.name} was left out: {each.failure}"
                for each in self.variants
                if each.failure
            ),
            *(
                f"{each.variant}, {each.condition}: {each.scores.failed}"
                for each in self.drives
                if each.scores is not None and each.scores.failed
            ),
            *([str(self.load)] if self.load is not None and self.load.busy else []),
        )
        return View(
            f"{study.title}: {plural(len(study.variants), 'variant')} under"
            f" {plural(len(study.conditions), 'condition')} on {driven} of"
            f" {plural(whole, 'route')}",
            chain.from_iterable(self.tables_by_section.values()),
            [f"{each.name}: {each.known}" for each in self.variants if each.known],
            alerts,
        )

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
        """Return a document; the same study and seed give the same bytes but latencies.

        Latencies, and the scale derived from them, are below the keys ``latency``.
        """
        study = self.study
        content = {
            "title": study.title,
            "baseline": study.baseline,
            "seed": study.seed,
            "provider": PROVIDERS.text(study.provider),
            "evaluator": study.evaluator,
            "routes": dict(zip(("driven", "set"), self.coverage, strict=True)),
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
        return plain(content)


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
    # what the columns of costs are
    if result.timed:
        scale = result.device_scale
        kind = f"times {scale:.3g}, one device scale for all"
        kind = "on this machine" if scale == 1.0 else kind
        note += f" Latency: models in turn, warm, {kind}."
    note += (
        f" Plan and SQNR: how far waypoints move from {study.baseline}'s on held-out"
        " frames, and the noise on them."
    )
    costs = {
        each.name: (
            measure_cell(each.size_mb, ".2f"),
            measure_cell(each.latency_ms[50], ".1f"),
            measure_cell(each.latency_ms[99], ".1f"),
            measure_cell(each.fidelity.plan_mean, ".3f"),
            measure_cell(each.fidelity.plan_sqnr, ".1f"),
        )
        for each in result.variants
    }
    rows = tuple(
        (Cell(result.label(each)), *_scores(each), *costs[each.variant])
        for each in result.drives
    )
    columns = ("variant", *SCORES, *COSTS)
    return Table("Scoreboard", columns, rows, note, study.baseline)


def _scores(drive: DriveRecord) -> tuple[Cell, ...]:
    if drive.scores is None:
        return (Cell(MISSING, reason=drive.reason),) * len(SCORES)
    of = drive.scores
    shown = (
        *(of.driving_score, of.safety.room_kept, of.success_rate, of.efficiency),
        *(of.bench2drive_efficiency, of.comfort, of.bench2drive_smoothness),
    )
    return tuple(map(estimate_cell, shown))


def difference_table(result: StudyResult) -> Table:
    """Show every variant minus the baseline, paired by route."""
    labels = [each for each in result.drives if each.difference is not None]
    gaps = [each.difference for each in labels if each.difference is not None]
    # p-values are corrected for all comparisons shown
    corrected = holm([each.p_value for each in gaps])
    rows = tuple(
        (
            Cell(result.label(drive)),
            *_gaps(gap),
            *map(Cell, (f"{p:.2g}", str(gap.better), str(gap.worse))),
        )
        for drive, gap, p in zip(labels, gaps, corrected, strict=True)
    )
    columns = (
        *("variant", "DS, points", "DS, other types", "room, points"),
        *("SR, points", "SR p", "routes better", "routes worse"),
    )
    title = f"Difference to {result.study.baseline} on the same routes"
    return Table(title, columns, rows, _differences_note(gaps))


def _differences_note(gaps: Sequence[PairedDifference]) -> str:
    note = (
        "Mean over routes with its 95 % interval, paired: an interval that holds zero "
        'shows no difference. It is for routes of these scenario types; "DS, other '
        "types\" for types drawn anew. SR p: McNemar's exact test"
    )
    # several comparisons: the correction, and its limits
    if len(gaps) > 1:
        note += (
            f", corrected for {len(gaps)} comparisons (Holm). Each interval is a 95 % "
            "interval by itself: one in twenty misses zero by chance where nothing "
            "differs"
        )
    note += "."
    # what so few routes cannot show
    if gaps:
        on, least = plural(gaps[0].driving_score.n, "route"), gaps[0].smallest_shown
        note += f" {on} cannot show a difference below {least:.1f} points."
    alike = [each for each in gaps if not each.differ]
    if alike:
        routes, share = alike[0].driving_score.n, alike[0].unseen_percent
        note += f" Where 0 of {routes} routes differ, at most {share:.1f} % do (95 %)."
    return note


def _gaps(of: Comparison | PairedDifference) -> tuple[Cell, ...]:
    """Show differences: driving score with both intervals, room kept, success rate."""
    estimates = of.driving_score, of.room_kept, of.success_rate
    score, room, rate = (estimate_cell(each, signed=True) for each in estimates)
    return score, anew_cell(of.driving_score), room, rate


def abilities(result: StudyResult) -> Table:
    """Show the success rate by ability of every drive."""
    columns = ("variant", *(name.replace("_", " ") for name in ABILITIES), "mean")
    rows = tuple(
        (
            Cell(result.label(each)),
            *map(estimate_cell, (*of.each_ability.values(), of.abilities)),
        )
        for each in result.drives
        if (of := each.scores) is not None
    )
    note = (
        "A route may test two abilities. Intervals are exact, the mean's by bootstrap."
    )
    title, strong = "Success by ability in %", result.study.baseline
    return Table(title, columns, rows, note, strong)


def pair_table(result: StudyResult) -> Table:
    """Show the pairs of drives that the study names."""
    rows = tuple(
        (Cell(each.drive), Cell(each.against), *_gaps(each)) for each in result.pairs
    )
    columns = (
        *("drive", "against", "DS, points", "DS, other types", "room, points"),
        "SR, points",
    )
    note = (
        "The first drive minus the second, mean over routes with its 95 % interval: one"
        " that holds zero shows no difference."
    )
    return Table("Pairs of drives on the same routes", columns, rows, note)


def route_tables(result: StudyResult) -> tuple[Table, ...]:
    """Show how each route ended for each driver; nothing if there are too many."""
    driven = [each for each in result.drives if each.routes]
    if not driven or len(driven[0].routes) > MOST_ROUTES:
        return ()
    rows = list[tuple[Cell, ...]]()
    for routes in zip(*(each.routes for each in driven), strict=True):
        cells = [Cell(routes[0].route)]
        for each in routes:
            room = "" if each.room_kept is None else f"; room {each.room_kept:.0f} %"
            cells.append(Cell(f"{each.driving_score:.1f}", f"{each.fate}{room}"))
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
            cells = (
                estimate_cell(safety.ttc_exposure),
                estimate_cell(safety.smallest_ttc, ".2f"),
                estimate_cell(safety.smallest_pet, ".2f"),
                estimate_cell(safety.smallest_distance, ".2f"),
                estimate_cell(safety.at_fault_collisions),
            )
        rows.append((Cell(result.label(drive)), *cells))
    return Table(
        "Near misses",
        ("variant", *columns),
        tuple(rows),
        "Means over routes with their 95 % intervals: share of the time with a time to "
        "collision below 1.5 s, the least of a route, post-encroachment time of "
        "crossing paths, smallest distance; and routes with a collision that the ego "
        "could have prevented. Least TTC and PET exist on some routes only.",
        result.study.baseline,
    )
