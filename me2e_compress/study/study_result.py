"""Result of a study: what it found, as lines, tables and JSON."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from me2e_compress.display import Cell, Table, counted
from me2e_compress.runtime.providers import PROVIDERS
from me2e_compress.study.cells import MISSING, estimate_cell
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.outcome import StudyOutcome
from me2e_compress.study.tables import (
    abilities,
    change_tables,
    differences,
    route_table,
    scoreboards,
)
from me2e_compress.workflows.result import Result


@dataclass(frozen=True, repr=False)
class StudyResult(StudyOutcome, Result):
    """All results of a study, and what they were made with."""

    @property
    def headline(self) -> str:
        """Title, and numbers of variants, conditions and routes."""
        study, (driven, whole) = self.study, self.coverage
        return (
            f"{study.title}: {counted(len(study.variants), 'variant')} under"
            f" {counted(len(study.conditions), 'condition')} on {driven} of"
            f" {counted(whole, 'route')}"
        )

    def lines(self) -> tuple[str, ...]:
        """Return nothing: the tables say it all."""
        return ()

    def alerts(self) -> tuple[str, ...]:
        """Return the variants that failed, and whether the machine was busy."""
        failed = [each.prepared for each in self.variants if each.prepared.failure]
        busy = [str(self.load)] if self.load is not None and self.load.busy else []
        left_out = (
            f"variant {each.variant.name} was left out: {each.failure}"
            for each in failed
        )
        broken = (
            f"{each.variant}, {each.condition}: {each.scores.failed}"
            for each in self.drives
            if each.scores is not None and each.scores.failed
        )
        return (*left_out, *broken, *busy)

    @property
    def tables_by_section(self) -> Mapping[str, tuple[Table, ...]]:
        """Every table, in reading order; a preview is marked as such."""
        route_by_route, several = route_table(self), len(self.variants) > 1
        found = {
            "Scoreboard": scoreboards(self),
            "Paired differences": (differences(self),) if several else (),
            "One change at a time": change_tables(self),
            "Route by route": () if route_by_route is None else (route_by_route,),
            "Near misses": (near_misses(self),),
            "Abilities": abilities(self),
        }
        preview = self.study.preview
        return {
            heading: tuple(replace(e, title=f"{e.title}{preview}") for e in tables)
            for heading, tables in found.items()
        }

    def tables(self) -> tuple[Table, ...]:
        """Return every table, in reading order."""
        by_section = self.tables_by_section.values()
        return tuple(table for tables in by_section for table in tables)

    def to_json(self) -> dict[str, Any]:
        """Return a document; the same study and seed give the same bytes but latencies.

        Latencies, and the scale derived from them, are below the keys ``latency``.
        """
        study = self.study
        return {
            "title": study.title,
            "baseline": study.baseline,
            "seed": study.seed,
            "provider": PROVIDERS.text(study.provider),
            "evaluator": study.evaluator,
            "routes": dict(zip(("driven", "set"), self.coverage, strict=True)),
            "conditions": [each.to_json() for each in study.conditions],
            "latency": {
                "device_scale": self.device_scale,
                "samples": study.timing.samples,
                "threads": study.timing.threads,
                **({} if self.load is None else self.load.to_json()),
            },
            "schemes": [each.to_json() for each in self.variants],
            "drives": [each.to_json() for each in self.drives],
            "changes": [each.to_json() for each in self.changes],
            "pairs": [each.to_json() for each in self.pairs],
            "machine": self.machine,
            "versions": dict(self.versions),
        }


def near_misses(outcome: StudyOutcome) -> Table:
    """Show how near every drive came to collisions, which end few routes."""
    columns = ("TTC < 1.5 s, %", "least TTC s", "PET s", "distance m", "at fault %")
    return Table(
        "Near misses",
        ("variant", *columns),
        tuple(
            (Cell(outcome.label(each)), *_safety(each, len(columns)))
            for each in outcome.drives
        ),
        "Means over routes with their 95 % intervals: share of the time with a time to "
        "collision below 1.5 s, the least of a route, post-encroachment time of "
        "crossing paths, smallest distance; and routes with a collision that the ego "
        "could have prevented. Least TTC and PET exist on some routes only.",
        outcome.study.baseline,
    )


def _safety(drive: DriveRecord, columns: int) -> tuple[Cell, ...]:
    if drive.scores is None:
        return (Cell(MISSING, reason=drive.reason),) * columns
    found = drive.scores.safety
    return (
        estimate_cell(found.ttc_exposure),
        estimate_cell(found.smallest_ttc, ".2f"),
        estimate_cell(found.smallest_pet, ".2f"),
        estimate_cell(found.smallest_distance, ".2f"),
        estimate_cell(found.at_fault_collisions),
    )
