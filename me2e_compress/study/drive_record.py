"""One drive: a line per route, without frames, and how it compares with the baseline.

A drive of 220 routes takes 30 MB of episodes and 0.1 MB of these lines.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Self

from pydantic import TypeAdapter

from me2e_compress.base import atomic, documents
from me2e_compress.base.atomic import write_bytes
from me2e_compress.base.errors import StudyError
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.route_summary import (
    DS,
    ROOM,
    SR,
    PairedDifference,
    RouteColumn,
    RouteSummary,
    RouteValues,
)
from me2e_compress.metrics.scores import Scores


@dataclass(frozen=True)
class _Head:
    """The first line of a file."""

    variant: str
    condition: str
    made_by: dict[str, Any]


_HEAD, _ROUTE = TypeAdapter(_Head), TypeAdapter(RouteSummary)


@dataclass(frozen=True)
class DriveRecord:
    """One variant under one condition, or the reason why it was not driven.

    Files hold names, ``made_by`` and the routes; the rest follows from episodes.
    """

    variant: str
    condition: str
    routes: tuple[RouteSummary, ...] = ()
    # Its fingerprint without the routes
    made_by: Mapping[str, Any] = field(default_factory=dict)
    scores: Scores | None = None
    # Paired by route with the baseline under the same condition; None for the baseline
    # itself
    difference: PairedDifference | None = None
    reason: str = ""

    @classmethod
    def of(
        cls,
        variant: str,
        condition: str,
        made_by: Mapping[str, Any],
        episodes: Iterable[Episode],
    ) -> Self:
        """Summarize episodes; ``made_by`` loses its redundant list of routes."""
        origin = {key: value for key, value in made_by.items() if key != "routes"}
        routes = (RouteSummary.of(episode).rounded() for episode in episodes)
        return cls(variant, condition, tuple(routes), origin)

    @property
    def name(self) -> str:
        """``VARIANT.CONDITION``."""
        return f"{self.variant}.{self.condition}"

    @property
    def mean_latency_us(self) -> int | None:
        """Mean latency of a decision; None without decisions."""
        decisions = sum(route.decisions for route in self.routes)
        total_us = sum(route.latency_sum_us for route in self.routes)
        return round(total_us / decisions) if decisions else None

    def values(self, column: RouteColumn) -> RouteValues:
        """Return one number of every route; of a drive not made, the reason."""
        return column.values(self.routes, self.reason)

    def minus(
        self, reference: "DriveRecord", column: RouteColumn = DS, seed: int = 0
    ) -> Estimate:
        """Return the mean of "this minus the reference" over routes that have both."""
        return (self.values(column) - reference.values(column)).mean(seed)

    def to_json(self) -> dict[str, Any]:
        """Return scores, difference and routes, as they stand in the study's JSON."""
        routes = [
            {
                "route": route.route,
                "driving_score": route.driving_score,
                "room_kept": route.room_kept,
                "succeeded": route.succeeded,
                "ending": route.ending,
                "infractions": [
                    {"kind": kind, "time_us": us} for kind, us in route.moments
                ],
            }
            for route in self.routes
        ]
        return {
            "scheme": self.variant,
            "condition": self.condition,
            "reason": self.reason or None,
            "scores": self.scores,
            "difference": self.difference,
            "routes": routes,
        }

    def save(self, path: Path) -> None:
        """Write it as JSON lines: the fingerprint, then one line per route."""
        head = asdict(_Head(self.variant, self.condition, dict(self.made_by)))
        rows = [_ROUTE.dump_python(route, mode="json") for route in self.routes]
        lines = [json.dumps(row, ensure_ascii=False) for row in (head, *rows)]
        with atomic.writing_errors(path, StudyError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, ("\n".join(lines) + "\n").encode())

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file that `save` wrote; a repeated route or a cut-off is an error."""
        # The first line is the fingerprint, each other one a route
        with documents.reading(path, StudyError, "not a record of a drive"):
            content = documents.read_bytes(path, documents.LARGEST_LOG_BYTES)
            text = content.decode("utf-8")
            if not text.endswith("\n"):
                raise documents.MalformedError("its last line was cut off")
            first, *rows = map(documents.from_json, text.splitlines())
            head = _HEAD.validate_python(first)
            routes = tuple(_ROUTE.validate_python(row) for row in rows)
            counts = Counter(route.route for route in routes)
            if twice := [name for name, count in counts.items() if count > 1]:
                raise documents.MalformedError(f"names route {twice[0]} twice")
            if not isinstance(head.made_by.get("set_size"), int):
                raise documents.MalformedError("it does not say of how many routes")
            return cls(head.variant, head.condition, routes, head.made_by)


@dataclass(frozen=True)
class Comparison:
    """One drive (``VARIANT.CONDITION``) minus another on the same routes, in points."""

    drive: str
    against: str
    driving_score: Estimate
    room_kept: Estimate
    success_rate: Estimate


def compare_pairs(
    pairs: Sequence[tuple[str, str]], drives: Sequence[DriveRecord], seed: int
) -> tuple[Comparison, ...]:
    """Compare pairs of drives (``VARIANT.CONDITION``) if both were driven."""
    driven = {drive.name: drive for drive in drives if drive.routes}
    comparisons = list[Comparison]()
    for one, other in pairs:
        if one in driven and other in driven:
            minus = partial(driven[one].minus, driven[other], seed=seed)
            comparisons.append(Comparison(one, other, *map(minus, (DS, ROOM, SR))))
    return tuple(comparisons)
