"""Files as a Bench2Drive run leaves them, made by hand, and what is read of them."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from me2e_compress.evaluators.bench2drive.real_results import (
    Bench2DriveResults,
    CollectedResults,
)

Json = dict[str, Any]

KEYS = (
    "collisions_layout",
    "collisions_pedestrian",
    "collisions_vehicle",
    "red_light",
    "stop_infraction",
    "outside_route_lanes",
    "min_speed_infractions",
    "yield_emergency_vehicle_infractions",
    "scenario_timeouts",
    "route_dev",
    "vehicle_blocked",
    "route_timeout",
)
RAMMED = (
    "Agent collided against object with type=vehicle.mini.cooper_s_2021 and id=56246 "
    "at (x=3130.105, y=5245.413, z=368.317)"
)
OUTSIDE = (
    "Agent went outside its route lanes for about 4.0 meters "
    "(6.12% of the completed route)"
)


def speed(percent: float) -> str:
    return f"Average speed is {percent}% of the surrounding traffic's one"


def record(
    number: int = 1711,
    scenario: str = "ParkingCutIn",
    status: str = "Completed",
    score: tuple[float, float, float] = (100, 1.0, 100.0),
    weather: str | None = "15",
    duration_s: float = 18.7,
    rep: int = 0,
    **messages: Sequence[str],
) -> Json:
    """A record with the messages of infractions by their key."""
    route = f"RouteScenario_{number}_rep{rep}"
    infractions = {key: list(messages.get(key, ())) for key in KEYS}
    completed, penalty, composed = score
    return {
        "index": 0,
        "route_id": route,
        "scenario_name": f"{scenario}_1",
        "weather_id": weather,
        "save_name": f"{route}_Town12_{scenario}_1_{weather}_06_16_22_20_36",
        "status": status,
        "num_infractions": sum(map(len, infractions.values())),
        "infractions": infractions,
        "scores": {
            "score_route": completed,
            "score_penalty": penalty,
            "score_composed": composed,
        },
        "meta": {
            "route_length": 133.138,
            "duration_game": duration_s,
            "duration_system": 23.039,
        },
        "town_name": "Town12",
    }


GOOD = record()


def checkpoint(*records: Json) -> Json:
    """A worker's file; without records that of one that was killed."""
    return {
        "_checkpoint": {
            "global_record": {},
            "progress": [len(records), max(1, len(records))],
            "records": list(records),
        },
        "entry_status": "Finished" if records else "Started",
        "eligible": bool(records),
        "sensors": ["carla_imu"],
        "values": ["100.0"],
        "labels": ["Avg. driving score"],
    }


def merged(*records: Json) -> Json:
    bare = [
        {key: record[key] for key in record if key != "index"} for record in records
    ]
    scores = [record["scores"]["score_composed"] for record in records]
    completed = [record for record in records if record["status"] == "Completed"]
    return {
        "_checkpoint": {"records": bare},
        "driving score": sum(scores) / 220,
        "success rate": len(completed) / 220,
        "eval num": len(records),
    }


def recording(
    steps: int = 60,
    interval_s: float = 0.05,
    yaw_degps: float = 8.0,
    speed_mps: float = 6.0,
    first: int = 0,
    every: int = 1,
) -> Json:
    """A steady turn to the right in CARLA's world, recorded at a rate."""
    rate = math.radians(yaw_degps)
    result: Json = {}
    for index in range(steps):
        yaw = rate * interval_s * index
        ahead = [math.cos(yaw), math.sin(yaw), 0.0]
        aside = [-math.sin(yaw), math.cos(yaw), 0.0]
        radius = speed_mps / rate if rate else 0.0
        along = speed_mps * interval_s * index
        place = (
            [radius * math.sin(yaw), radius * (1 - math.cos(yaw)), 0.3]
            if rate
            else [along, 0.0, 0.3]
        )
        result[str(first + every * index)] = {
            "acceleration": [speed_mps * rate * share for share in aside],
            "angular_velocity": [0.0, 0.0, yaw_degps],
            "forward_vector": ahead,
            "right_vector": aside,
            "location": place,
            "rotation": [0.0, 0.0, math.degrees(yaw)],
        }
    return result


def write(path: Path, document: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document, indent=4), encoding="utf-8")
    return path


def collect(folder: Path) -> CollectedResults:
    return Bench2DriveResults(folder).collect()
