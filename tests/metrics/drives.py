"""Episodes made by hand."""

import dataclasses
import math
from collections.abc import Callable

from me2e_compress.metrics.episode import (
    FRAME_US,
    ConflictRecord,
    EgoFrame,
    Ending,
    Episode,
    InferenceRecord,
    Infraction,
    InfractionKind,
)

STILL = EgoFrame(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, None)


def frames(
    count: int, at: Callable[[int], dict[str, float | None]] = lambda _: {}
) -> tuple[EgoFrame, ...]:
    """Frames every 50 ms; `at` says what differs from standing still."""
    return tuple(
        dataclasses.replace(STILL, time_us=k * FRAME_US, **at(k))  # type: ignore[arg-type]
        for k in range(count)
    )


def cruise(
    length_m: float = 100.0, speed: float = 10.0, traffic: float | None = None
) -> tuple[EgoFrame, ...]:
    """Constant speed from the start to the end of a route."""
    count = math.ceil(length_m / speed / 0.05) + 1
    speeds = {"speed_mps": speed, "traffic_speed_mps": traffic}
    return frames(
        count, lambda k: {**speeds, "route_m": min(speed * 0.05 * k, length_m)}
    )


def infraction(kind: InfractionKind, percent: float | None = None) -> Infraction:
    return Infraction(kind, 1_000_000, 3.0, 4.0, "by hand", percent)


def drive(
    *infractions: Infraction,
    completion: float = 100.0,
    abilities: tuple[str, ...] = ("Merging",),
    driven: tuple[EgoFrame, ...] = (),
    ending: Ending = Ending.COMPLETED,
    length_m: float = 100.0,
    junction_m: float | None = None,
    ratios: tuple[float, ...] | None = None,
    route: str = "r1",
    conflicts: ConflictRecord | None = None,
) -> Episode:
    return Episode(
        route,
        "HighwayExit",
        abilities,
        length_m,
        completion,
        ending,
        None,
        infractions,
        driven,
        (InferenceRecord(0, 100_000),),
        junction_m,
        ratios,
        conflicts=conflicts,
    )
