"""The part of a drive that tables need: one line per route, without frames.

A drive of 220 routes takes 30 MB of episodes and 0.1 MB of these lines.
"""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import ConfigDict, TypeAdapter, with_config

from me2e_compress import documents
from me2e_compress.errors import StudyError
from me2e_compress.metrics import surrogate_safety as near
from me2e_compress.metrics.comfort import comfort
from me2e_compress.metrics.driving_score import route_score
from me2e_compress.metrics.efficiency import efficiency
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.infraction import COLLISIONS
from me2e_compress.runtime.atomic import write_bytes

PERCENTS = (50, 90, 99, 100)
"""Percentiles of the latencies of a route's decisions."""
DIGITS = 6

_STRICT = ConfigDict(allow_inf_nan=False, extra="forbid")


@with_config(_STRICT)
@dataclass(frozen=True)
class RouteSummary:
    """One route of one drive; unrecorded values are None.

    Attributes:
        driving_score: Percent, as are completion, efficiency and ttc_exposure.
        succeeded: Whether the whole route was driven without an infraction.
        infractions: Kind, microseconds if known, and the other party or obstacle.
        efficiency: None if no traffic moved, or the ego did not.
        comfort: Share of smooth segments; None if there was no whole one.
        duration_us: Time of the last frame.
        latency_us: `PERCENTS` of the decisions' latencies on the vehicle.
        ttc_exposure: Share of the frames with a time to collision below 1.5 s.
        smallest_pet: Post-encroachment time of crossing paths, seconds.
    """

    route: str
    scenario: str
    driving_score: float
    completion: float
    succeeded: bool
    ending: str
    infractions: tuple[tuple[str, int | None, str], ...]
    efficiency: float | None
    comfort: float | None
    duration_us: int
    decisions: int
    latency_us: tuple[int, ...]
    latency_sum_us: int
    ttc_exposure: float | None = None
    smallest_ttc: float | None = None
    smallest_pet: float | None = None
    smallest_distance: float | None = None
    at_fault: bool | None = None

    @property
    def collisions(self) -> tuple[tuple[str, str], ...]:
        """Kind and other party of each collision."""
        return tuple(
            (kind, detail) for kind, _, detail in self.infractions if kind in COLLISIONS
        )

    @classmethod
    def of(cls, episode: Episode) -> Self:
        """Summarize an episode."""
        # percentiles of the latency that the drive was charged
        charged = [each.latency_us for each in episode.decisions]
        latency_us = np.percentile(charged or [0], PERCENTS, method="higher")
        return cls(
            episode.route,
            episode.scenario,
            route_score(episode).composed,
            episode.completion_percent,
            episode.succeeded,
            episode.ending.value,
            tuple((e.kind.value, e.time_us, e.detail) for e in episode.infractions),
            _rounded(efficiency(episode).value),
            _rounded(comfort(episode).value),
            episode.frames[-1].time_us if episode.frames else 0,
            len(charged),
            tuple(int(each) for each in latency_us) if charged else (),
            sum(charged),
            _rounded(near.ttc_exposure(episode).value),
            _rounded(near.smallest_ttc(episode).value),
            _rounded(near.smallest_pet(episode).value),
            _rounded(near.smallest_distance(episode).value),
            near.at_fault_collision(episode),
        )


_ROUTE = TypeAdapter(RouteSummary)


@dataclass(frozen=True)
class DriveRecord:
    """One drive over routes; ``made_by`` is its fingerprint without the routes."""

    variant: str
    condition: str
    set_size: int
    made_by: Mapping[str, Any]
    routes: tuple[RouteSummary, ...]

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
        routes = tuple(map(RouteSummary.of, episodes))
        return cls(variant, condition, int(made_by["set_size"]), kept, routes)

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
            made_by, set_size = head["made_by"], int(head["made_by"]["set_size"])
            record = cls(head["variant"], head["condition"], set_size, made_by, routes)
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


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, DIGITS)
