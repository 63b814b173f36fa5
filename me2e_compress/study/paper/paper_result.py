"""Results of the paper's study so far."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from me2e_compress.study.definition import Study
from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.paper.accident import Accident
from me2e_compress.study.paper.model_facts import ModelFacts
from me2e_compress.study.paper.paper_findings import findings
from me2e_compress.study.paper.paper_tables import all_paper_tables
from me2e_compress.study.paper.questions import Finding, findings_table
from me2e_compress.study.paper.route_columns import COLUMNS, mean_of
from me2e_compress.workflows.result import Result, Table

CellKey = tuple[str, str]
"""A variant and a condition, by their names."""


@dataclass(frozen=True, repr=False)
class PaperResult(Result):
    """The drives that were made, and facts about the files that drove.

    ``cells`` are the finished drives, ``failures`` the reasons of the others; the
    device is ``device_scale`` times slower than the machine timed on.
    """

    study: Study
    facts: tuple[ModelFacts, ...]
    cells: Mapping[CellKey, DriveRecord]
    failures: Mapping[CellKey, str]
    device_scale: float
    machine: str
    accident: Accident | None = None

    @property
    def title(self) -> str:
        """The study's title, with a note if not all routes were driven."""
        return f"{self.study.title}{self.preview}"

    @property
    def preview(self) -> str:
        """Suffix of titles if only a part of the routes is driven; empty otherwise."""
        return self.study.preview

    @property
    def headline(self) -> str:
        """Title, and number of drives."""
        wanted = sum(
            len(self.study.driven_under(each)) for each in self.study.conditions
        )
        return f"{self.title}: {len(self.cells)} of {wanted} drives"

    def fact(self, variant: str) -> ModelFacts:
        """Return the facts about a variant; empty facts if it was not prepared."""
        found = (each for each in self.facts if each.variant == variant)
        return next(found, ModelFacts(variant))

    def cell(self, variant: str, condition: str) -> DriveRecord | None:
        """Return a drive; None if it was not driven."""
        return self.cells.get((variant, condition))

    def why_not(self, variant: str, condition: str) -> str:
        """Say why a cell is empty."""
        reason = self.failures.get((variant, condition))
        failed = reason or self.fact(variant).failure
        return failed or f"{variant} under {condition}: not driven"

    @functools.cached_property
    def findings(self) -> tuple[Finding, ...]:
        """The paper's findings as questions, answered by these drives."""
        return findings(self)

    def tables(self) -> tuple[Table, ...]:
        """Return the findings, then the paper's tables in its order."""
        return findings_table(self.findings, self.preview), *all_paper_tables(self)

    def alerts(self) -> tuple[str, ...]:
        """Return the drives that failed, and why."""
        return tuple(
            f"{variant} under {condition} was left out: {why}"
            for (variant, condition), why in self.failures.items()
        )

    def records(self) -> list[dict[str, object]]:
        """Return one row per drive."""
        return [
            {
                "variant": variant,
                "condition": condition,
                "routes": len(cell.routes),
                **{each.name: mean_of(cell, each).value for each in COLUMNS},
            }
            for (variant, condition), cell in self.cells.items()
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the scores of every drive, and the facts about the files."""
        seed = self.study.seed
        return {
            "title": self.title,
            "baseline": self.study.baseline,
            "seed": seed,
            "routes": {"driven": len(self.study.routes), "set": self.study.set_size},
            "device_scale": self.device_scale,
            "machine": self.machine,
            "drives": [
                {
                    "scheme": variant,
                    "condition": condition,
                    "routes": len(cell.routes),
                    "scores": {
                        each.name: mean_of(cell, each, seed).to_json()
                        for each in COLUMNS
                    },
                }
                for (variant, condition), cell in self.cells.items()
            ],
            "findings": [each.to_json() for each in self.findings],
            "failures": [
                {"scheme": variant, "condition": condition, "reason": why}
                for (variant, condition), why in self.failures.items()
            ],
        }
