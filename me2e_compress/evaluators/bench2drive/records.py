"""One record of a results file: how a route ended, its infractions and scores.

The format is that of leaderboard/utils/statistics_manager.py, shared by Bench2Drive and
the CARLA leaderboard; Bench2Drive adds scenario and recording folder.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from me2e_compress.metrics.episode import (
    LARGEST,
    Ending,
    Episode,
    Given,
    Infraction,
    InfractionKind,
)
from me2e_compress.simulator.routes import SCENARIO_ABILITIES

_PERCENT = re.compile(r"\b\d+\.?\d*%")
"""The first percentage of a message, as efficiency_smoothness_benchmark.py finds it."""
_OUTSIDE = re.compile(r"\((\d+\.?\d*)% of")
_PLACE = re.compile(r"\(x=(-?\d+(?:\.\d+)?), y=(-?\d+(?:\.\d+)?)")
_NUMBER = re.compile(r"_\d+$")
"""What a scenario's name has after its type: ``ParkingCutIn_1``."""
_ROUTE = re.compile(r"[\w.-]{1,200}")

_FAILED = "Failed"
ENDINGS: Mapping[str, Ending] = MappingProxyType(
    {
        "Completed": Ending.COMPLETED,
        "Perfect": Ending.COMPLETED,
        "Failed - Agent deviated from the route": Ending.DEVIATION,
        "Failed - Agent got blocked": Ending.BLOCKED,
        "Failed - Agent timed out": Ending.TIMEOUT,
        "Failed - TickRuntime": Ending.TIMEOUT,
        "Failed - Agent crashed": Ending.POLICY_FAILED,
        "Failed - Agent couldn't be set up": Ending.POLICY_FAILED,
        "Failed - Agent's sensors were invalid": Ending.POLICY_FAILED,
        "Failed - Simulation crashed": Ending.SIMULATOR_FAILED,
        _FAILED: Ending.SIMULATOR_FAILED,
    }
)
"""By status. Bench2Drive repeats a route whose status is just ``Failed``,
as after a crash."""
CRASHES = (Ending.POLICY_FAILED, Ending.SIMULATOR_FAILED)


class BrokenRecordError(ValueError):
    """A record is incomplete; the message is one line, without the file name."""


@dataclass(frozen=True)
class RouteRecord:
    """One parsed record.

    Attributes:
        episode: The episode, without frames.
        number: The route's id in its routes file, such as ``1711``.
        recording: Name of the folder of its ``metric_info.json``, if any.
        duration_s: Simulated seconds; None if not stated.
        content: Result of the route, to tell a copy from another drive.
        notes: What could not be interpreted, one line each.
    """

    episode: Episode
    number: str
    recording: str | None
    duration_s: float | None
    content: str
    notes: tuple[str, ...] = ()

    @property
    def crashed(self) -> bool:
        """Whether the simulator or the agent broke down."""
        return self.episode.ending in CRASHES


def read_record(raw: object) -> RouteRecord:
    """Read one parsed record; its numbers may be infinite or NaN.

    An unfinished route raises a `BrokenRecordError`, too.
    """
    try:
        record = _Record.model_validate(raw)
    except ValidationError as error:
        raise BrokenRecordError(_complaint(error)) from error
    if not _ROUTE.fullmatch(record.route_id):
        raise BrokenRecordError(f"route_id: {record.route_id[:60]!r} is no name")
    # infractions, ending and scenario
    infractions, ratios, notes = _infractions(record)
    ending = _ending(record.status)
    scenario = _NUMBER.sub("", record.scenario_name or "")
    episode = Episode(
        route=record.route_id,
        scenario=scenario,
        abilities=SCENARIO_ABILITIES.get(scenario, ()),
        route_length_m=record.meta.route_length,
        completion_percent=record.scores.score_route,
        ending=ending,
        failure=record.status if ending in CRASHES else None,
        infractions=infractions,
        frames=(),
        decisions=(),
        speed_ratios_percent=ratios,
        given=Given(
            record.status,
            record.scores.score_route,
            record.scores.score_penalty,
            record.scores.score_composed,
        ),
    )
    # metadata that tells copies from other drives
    duration_s = record.meta.duration_game
    return RouteRecord(
        episode,
        number_of(record.route_id),
        record.save_name or None,
        duration_s if duration_s and duration_s > 0.0 else None,
        record.model_dump_json(exclude={"save_name", "meta"}),
        notes,
    )


def number_of(route_id: str) -> str:
    """Return ``1711`` for ``RouteScenario_1711_rep0``, as Bench2Drive's tools do."""
    parts = route_id.split("_")
    return parts[1] if len(parts) > 1 else route_id


_Finite = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)


class _Scores(_Part):
    score_route: Annotated[float, Field(ge=0.0, le=100.0)]
    score_penalty: _Finite
    score_composed: _Finite


class _Meta(_Part):
    route_length: Annotated[float, Field(ge=0.0, le=LARGEST)] = 0.0
    duration_game: _Finite | None = None


class _Record(_Part):
    route_id: str
    scenario_name: str | None = None
    save_name: str | None = None
    status: str
    infractions: dict[str, list[str]]
    scores: _Scores
    meta: _Meta = Field(default_factory=_Meta)


def _complaint(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in first["loc"]) or "record"
    return f"{where}: {first['msg']}"


def _ending(status: str) -> Ending:
    if status in ENDINGS:
        return ENDINGS[status]
    if status.startswith(_FAILED):
        return Ending.SIMULATOR_FAILED
    raise BrokenRecordError(f"status {status[:60]!r} is not that of a finished route")


def _infractions(
    record: _Record,
) -> tuple[tuple[Infraction, ...], tuple[float, ...], tuple[str, ...]]:
    """Return infractions, speed percentages, and notes on what is unclear."""
    found, notes = list[Infraction](), list[str]()
    for key, messages in record.infractions.items():
        if key not in set(InfractionKind):
            if messages:
                raise BrokenRecordError(f"infractions: nobody knows {key[:60]!r}")
            continue
        kind = InfractionKind(key)
        found += (_infraction(kind, message) for message in messages)
    notes += _lacking(found)
    ratios = tuple(
        each.percent
        for each in found
        if each.kind is InfractionKind.MIN_SPEED and each.percent is not None
    )
    return tuple(found), ratios, tuple(notes)


def _infraction(kind: InfractionKind, message: str) -> Infraction:
    place = _PLACE.search(message)
    x, y = (float(part) for part in place.groups()) if place else (None, None)
    return Infraction(
        kind,
        None,
        x,
        None if y is None else -y,  # CARLA's y points right
        " ".join(message.split())[:200],
        _percent(kind, message),
    )


def _percent(kind: InfractionKind, message: str) -> float | None:
    """Read the share outside the lanes, or the speed relative to the traffic's."""
    if kind is InfractionKind.OUTSIDE_ROUTE_LANES:
        share = _OUTSIDE.search(message) or _PERCENT.search(message)
    elif kind is InfractionKind.MIN_SPEED:
        share = _PERCENT.search(message)
    else:
        return None
    if share is None:
        return None
    return min(float(share.group(share.re.groups).rstrip("%")), LARGEST)


def _lacking(infractions: list[Infraction]) -> Iterator[str]:
    """Name the messages that lack an expected percentage."""
    kinds = (InfractionKind.OUTSIDE_ROUTE_LANES, InfractionKind.MIN_SPEED)
    for each in infractions:
        if each.kind in kinds and each.percent is None:
            yield f"{each.kind.value}: no percentage in {each.detail[:60]!r}: left out"
