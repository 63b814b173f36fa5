"""One drive: a line per route, without frames, and how it compares with the baseline.

A drive of 220 routes takes 30 MB of episodes and 0.1 MB of these lines.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import TypeAdapter

from me2e_compress import documents
from me2e_compress.errors import StudyError
from me2e_compress.metrics.differences import PairedDifference
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.scores import Scores
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.study.route_summary import RouteSummary

_ROUTE = TypeAdapter(RouteSummary)


@dataclass(frozen=True)
class Apart:
    """Greatest distance to the baseline's ego at the same time, and that time."""

    distance_m: float
    time_us: int


@dataclass(frozen=True)
class DriveRecord:
    """One variant under one condition, or the reason why it was not driven.

    Files hold names, ``made_by`` and the routes; the rest follows from episodes.

    Attributes:
        made_by: Its fingerprint without the routes.
        difference: Paired by route with the baseline under the same condition; None for
            the baseline itself.
        apart: By route, how far it was from the baseline; without routes that have no
            frames.
    """

    variant: str
    condition: str
    routes: tuple[RouteSummary, ...] = ()
    made_by: Mapping[str, Any] = field(default_factory=dict)
    scores: Scores | None = None
    difference: PairedDifference | None = None
    apart: Mapping[str, Apart] = field(default_factory=dict)
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
        kept = {key: value for key, value in made_by.items() if key != "routes"}
        return cls(variant, condition, tuple(map(RouteSummary.of, episodes)), kept)

    @property
    def set_size(self) -> int:
        """Number of routes of the whole set."""
        return int(self.made_by["set_size"])

    @property
    def mean_latency_us(self) -> int | None:
        """Mean latency of a decision; None without decisions."""
        decisions = sum(each.decisions for each in self.routes)
        taken = sum(each.latency_sum_us for each in self.routes)
        return round(taken / decisions) if decisions else None

    @property
    def decisions_a_second(self) -> float:
        """Decisions over the time driven; 0 if no time passed."""
        time_us = sum(each.duration_us for each in self.routes)
        return 1e6 * sum(each.decisions for each in self.routes) / max(time_us, 1)

    def to_json(self) -> dict[str, Any]:
        """Return scores, difference and routes, as they stand in the study's JSON."""
        return {
            "scheme": self.variant,
            "condition": self.condition,
            "reason": self.reason or None,
            "scores": self.scores.to_json() if self.scores else None,
            "difference": self.difference.to_json() if self.difference else None,
            "routes": [self._route_json(each) for each in self.routes],
        }

    def _route_json(self, route: RouteSummary) -> dict[str, Any]:
        apart = self.apart.get(route.route)
        return {
            "route": route.route,
            "driving_score": route.driving_score,
            "succeeded": route.succeeded,
            "ending": route.ending,
            "infractions": [
                {"kind": kind, "time_us": time_us} for kind, time_us in route.moments
            ],
            "apart_m": None if apart is None else apart.distance_m,
        }

    def save(self, path: Path) -> None:
        """Write it as JSON lines: the fingerprint, then one line per route."""
        head = {
            "variant": self.variant,
            "condition": self.condition,
            "made_by": self.made_by,
        }
        rows = [_ROUTE.dump_python(each, mode="json") for each in self.routes]
        lines = [json.dumps(row, ensure_ascii=False) for row in (head, *rows)]
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, ("\n".join(lines) + "\n").encode())
        except OSError as error:
            raise StudyError(f"{path}: cannot be written: {error.strerror}") from error

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file that `save` wrote; a repeated route or a cut-off is an error."""
        try:
            head, *rows = map(documents.from_json, _lines(path))
            routes = tuple(_ROUTE.validate_python(row) for row in rows)
            record = cls(head["variant"], head["condition"], routes, head["made_by"])
            int(record.set_size)  # a head without one is spoilt
        except OSError as error:
            raise StudyError(f"{path}: cannot be read: {error.strerror}") from error
        except (ValueError, KeyError, TypeError) as error:
            words = " ".join(str(error).split())[:200]
            raise StudyError(f"{path}: not a record of a drive: {words}") from error
        names = [each.route for each in routes]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise StudyError(f"{path}: names route {twice} twice")
        return record

    def difference_from(self, made_by: Mapping[str, Any]) -> str:
        """Say how another fingerprint differs from its own; empty if it does not."""
        for key in sorted({*made_by, *self.made_by} - {"routes"}):
            old, new = self.made_by.get(key), made_by.get(key)
            if old != new:
                return f"its {key} is {str(old)[:60]}, this one's {str(new)[:60]}"
        return ""


def _lines(path: Path) -> list[str]:
    text = documents.content(path, documents.LARGEST_LOG_BYTES).decode("utf-8")
    if not text.endswith("\n"):
        raise ValueError("its last line was cut off")
    return text.splitlines()


def apart(
    episodes: Sequence[Episode], reference: Sequence[Episode]
) -> dict[str, Apart]:
    """Return how far two drives of the same routes part, by route."""
    both = zip(episodes, reference, strict=True)
    return {
        one.route: _apart(one, other)
        for one, other in both
        if one.frames and other.frames
    }


def _apart(one: Episode, other: Episode) -> Apart:
    count = min(len(one.frames), len(other.frames))
    here, there = (
        np.array([(frame.x, frame.y) for frame in each.frames[:count]])
        for each in (one, other)
    )
    gaps = np.hypot(*(here - there).T)
    at = int(gaps.argmax())
    return Apart(float(gaps[at]), one.frames[at].time_us)
