"""Drives of the paper's study so far, apart from what they say about its findings."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass

from me2e_compress.study.drive_record import DriveRecord
from me2e_compress.study.outcome import StudyOutcome
from me2e_compress.study.paper.accident import Accident
from me2e_compress.study.paper.model_facts import ModelFacts

CellKey = tuple[str, str]
"""A variant and a condition, by their names."""


@dataclass(frozen=True, repr=False)
class PaperDrives(StudyOutcome):
    """The drives that were made, and facts about the files that drove.

    Its drives have no scores, its facts stand for variants.
    """

    facts: tuple[ModelFacts, ...] = ()
    accident: Accident | None = None

    @property
    def title(self) -> str:
        """The study's title, with a note if not all routes were driven."""
        return f"{self.study.title}{self.preview}"

    @property
    def preview(self) -> str:
        """Suffix of titles if only a part of the routes is driven; empty otherwise."""
        return self.study.preview

    @functools.cached_property
    def cells(self) -> Mapping[CellKey, DriveRecord]:
        """The finished drives."""
        return {
            (each.variant, each.condition): each
            for each in self.drives
            if not each.reason
        }

    @functools.cached_property
    def failures(self) -> Mapping[CellKey, str]:
        """Reasons of the drives that failed."""
        return {
            (each.variant, each.condition): each.reason
            for each in self.drives
            if each.reason
        }

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
