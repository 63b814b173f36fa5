"""Results of the paper's study so far."""

import functools
from dataclasses import dataclass
from typing import Any

from me2e_compress.study.paper.paper_drives import PaperDrives
from me2e_compress.study.paper.paper_findings import findings
from me2e_compress.study.paper.paper_tables import all_paper_tables
from me2e_compress.study.paper.questions import Finding, findings_table
from me2e_compress.study.route_columns import COLUMNS, mean_of
from me2e_compress.study.study_result import StudyResult
from me2e_compress.workflows.result import Table


@dataclass(frozen=True, repr=False)
class PaperResult(PaperDrives, StudyResult):
    """A study's result in the paper's tables, with its findings as questions."""

    @property
    def headline(self) -> str:
        """Title, and number of drives."""
        wanted = sum(
            len(self.study.driven_under(each)) for each in self.study.conditions
        )
        return f"{self.title}: {len(self.cells)} of {wanted} drives"

    @functools.cached_property
    def findings(self) -> tuple[Finding, ...]:
        """The paper's findings as questions, answered by these drives."""
        return findings(self)

    def tables(self) -> tuple[Table, ...]:
        """Return the findings, then the paper's tables in its order."""
        return findings_table(self.findings, self.preview), *all_paper_tables(self)

    def lines(self) -> tuple[str, ...]:
        """Return how many drives there are."""
        return (self.headline,)

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
