"""Routes and their manifest, a JSON list of objects; and the 44 types of scenarios.

Abilities are those of Bench2Drive (`tools/ability_benchmark.py` of
Thinklab-SJTU/Bench2Drive 0.0.3 and 0.0.4, which agree): a type counts under one ability
or under two, of which the second is Traffic_Signs. A type keeps the idea of its
namesake in scenario_runner, on our roads; its layout or script says where it differs.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from me2e_compress.base import atomic, documents
from me2e_compress.base.atomic import IN_JSON, write_bytes
from me2e_compress.base.errors import EvaluationError
from me2e_compress.metrics.bench2drive import TRAFFIC_SIGNS

# Name, simulated seconds of the expert (mean of five routes), abilities
_TYPES: tuple[tuple[str | int, ...], ...] = (
    ("Accident", 12, "Overtaking"),
    ("AccidentTwoWays", 18, "Overtaking"),
    ("ConstructionObstacle", 12, "Overtaking"),
    ("ConstructionObstacleTwoWays", 17, "Overtaking"),
    ("HazardAtSideLane", 12, "Overtaking"),
    ("HazardAtSideLaneTwoWays", 21, "Overtaking"),
    ("ParkedObstacle", 12, "Overtaking"),
    ("ParkedObstacleTwoWays", 16, "Overtaking"),
    ("VehicleOpensDoorTwoWays", 13, "Overtaking"),
    ("CrossingBicycleFlow", 21, "Merging", TRAFFIC_SIGNS),
    ("EnterActorFlow", 34, "Merging", TRAFFIC_SIGNS),
    ("HighwayExit", 17, "Merging"),
    ("InterurbanActorFlow", 23, "Merging"),
    ("HighwayCutIn", 11, "Merging"),
    ("InterurbanAdvancedActorFlow", 28, "Merging"),
    ("MergerIntoSlowTrafficV2", 49, "Merging"),
    ("MergerIntoSlowTraffic", 40, "Merging"),
    ("NonSignalizedJunctionLeftTurn", 22, "Merging", TRAFFIC_SIGNS),
    ("NonSignalizedJunctionRightTurn", 30, "Merging", TRAFFIC_SIGNS),
    ("NonSignalizedJunctionLeftTurnEnterFlow", 27, "Merging", TRAFFIC_SIGNS),
    ("ParkingExit", 24, "Merging"),
    ("SequentialLaneChange", 18, "Merging"),
    ("SignalizedJunctionLeftTurn", 23, "Merging", TRAFFIC_SIGNS),
    ("SignalizedJunctionRightTurn", 29, "Merging", TRAFFIC_SIGNS),
    ("SignalizedJunctionLeftTurnEnterFlow", 27, "Merging", TRAFFIC_SIGNS),
    ("BlockedIntersection", 20, "Emergency_Brake", TRAFFIC_SIGNS),
    ("DynamicObjectCrossing", 14, "Emergency_Brake"),
    ("HardBreakRoute", 11, "Emergency_Brake"),
    ("OppositeVehicleTakingPriority", 14, "Emergency_Brake", TRAFFIC_SIGNS),
    ("OppositeVehicleRunningRedLight", 14, "Emergency_Brake", TRAFFIC_SIGNS),
    ("ParkingCutIn", 13, "Emergency_Brake"),
    ("PedestrianCrossing", 13, "Emergency_Brake", TRAFFIC_SIGNS),
    ("ParkingCrossingPedestrian", 15, "Emergency_Brake"),
    ("StaticCutIn", 13, "Emergency_Brake"),
    ("VehicleTurningRoute", 17, "Emergency_Brake", TRAFFIC_SIGNS),
    ("VehicleTurningRoutePedestrian", 18, "Emergency_Brake", TRAFFIC_SIGNS),
    ("ControlLoss", 12, "Emergency_Brake"),
    ("InvadingTurn", 13, "Give_Way"),
    ("YieldToEmergencyVehicle", 15, "Give_Way"),
    ("T_Junction", 27, TRAFFIC_SIGNS),
    ("VanillaNonSignalizedTurn", 23, TRAFFIC_SIGNS),
    ("VanillaSignalizedTurnEncounterGreenLight", 27, TRAFFIC_SIGNS),
    ("VanillaSignalizedTurnEncounterRedLight", 26, TRAFFIC_SIGNS),
    ("VanillaNonSignalizedTurnEncounterStopsign", 25, TRAFFIC_SIGNS),
)

# Scenario type to its one or two abilities, in Bench2Drive's order
SCENARIO_ABILITIES: dict[str, tuple[str, ...]] = {
    str(name): tuple(map(str, abilities)) for name, _, *abilities in _TYPES
}

# Scenario type to how long it typically takes. Only the order in which routes begin and
# the length of recorded scenes depend on it, never a result.
EXPERT_S: dict[str, int] = {str(name): int(seconds) for name, seconds, *_ in _TYPES}

Parameter = bool | int | float | str

# The routes that ship: 44 scenario types, 5 variants each
SHIPPED = Path(__file__).with_name("routes_220.json")


GENERATION = {"road": 2}  # what every route says in a file, and what its digest counts
DIGEST = "set_sha256"  # in a set's first record: its routes as they were admitted
# What makes roads and traffic of a route, in the first record of a set and in the
# manifest of its drives: another version makes another route of it
VERSION, ROAD_VERSION = "road_version", 1


@dataclass(frozen=True)
class Route:
    """One route: a scenario type and everything that decides how it unfolds.

    The id, of letters, digits, ``_`` and ``-``, is unique in its manifest. The seed
    decides every parameter that is not given, so editing one changes that one and
    nothing else.
    """

    id: str
    scenario: str
    seed: int
    parameters: dict[str, Parameter] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not is_route_id(self.id):
            raise EvaluationError(
                f"route id {self.id!r}: only letters, digits, '_' and '-' are allowed"
            )
        if self.scenario not in SCENARIO_ABILITIES:
            raise EvaluationError(
                f"route {self.id}: no scenario {self.scenario!r}; there are "
                f"{', '.join(sorted(SCENARIO_ABILITIES))}"
            )

    @property
    def abilities(self) -> tuple[str, ...]:
        """Every ability that the scenario type counts under."""
        return SCENARIO_ABILITIES[self.scenario]

    def record(self) -> dict[str, Any]:
        """Return it as files and digests hold it, with its type's first ability."""
        named = {"id": self.id, "scenario": self.scenario, "ability": self.abilities[0]}
        return {**named, "seed": self.seed, "parameters": self.parameters, **GENERATION}


def is_route_id(text: str) -> bool:
    """Return whether a text can be the id of a route, and so part of a file name."""
    return 0 < len(text) <= 200 and all(c.isalnum() or c in "_-" for c in text)


_MANIFEST = TypeAdapter(list[Route])


def load_routes(path: Path = SHIPPED) -> tuple[Route, ...]:
    """Read a manifest.

    Raises:
        EvaluationError: The file is missing, not a manifest, or repeats an id; or it
            was changed after it was made, or made by another version of the generator.
    """
    with documents.reading(path, EvaluationError, "not routes"):
        content = documents.read_bytes(path)
        routes = _MANIFEST.validate_json(content, strict=True)
    # Check that they are a set of this road, as it was admitted
    if routes:
        first = json.loads(content)[0]
        check_version(path, first.get(VERSION))
        if first.get(DIGEST) != digest_of(routes):
            raise EvaluationError(
                f"{path}: changed after its routes were admitted (its {DIGEST} does not"
                " fit them); python -m benchmarks.tools.admit_routes of the repository"
                " makes a set"
            )
    # Check that ids are unique
    ids = [route.id for route in routes]
    for index, name in enumerate(ids):
        if (first := ids.index(name)) < index:
            raise EvaluationError(
                f"{path}: routes {first} and {index} share the id {name}"
            )
    return tuple(routes)


def check_version(path: Path, version: object) -> None:
    """Refuse what another version of the generator made.

    Raises:
        EvaluationError: It did.
    """
    if version != ROAD_VERSION:
        raise EvaluationError(
            f"{path}: is of version {version} of the generator of routes; this is"
            f" version {ROAD_VERSION}, which makes other roads and traffic of it"
        )


def digest_of(routes: Sequence[Route]) -> str:
    """Return the sha256 of the definitions of some routes."""
    definitions = json.dumps([route.record() for route in routes], sort_keys=True)
    return hashlib.sha256(definitions.encode()).hexdigest()


def save_routes(routes: Sequence[Route], path: Path) -> None:
    """Write a manifest atomically, one route a line."""
    records = [route.record() for route in routes]
    made = {VERSION: ROAD_VERSION, DIGEST: digest_of(routes)}
    if records:  # a list has no other place for what holds for all
        records[0] = {**IN_JSON, **made, **records[0]}
    lines = ",\n".join(map(json.dumps, records))
    with atomic.writing_errors(path, EvaluationError):
        write_bytes(path, f"[\n{lines}\n]\n".encode())


def pick_routes(routes: Sequence[Route], which: str) -> tuple[Route, ...]:
    """Return the routes that ``which`` asks for.

    It is ``all``, a number N (N routes spread evenly over the manifest), or ids
    separated by commas.

    Raises:
        EvaluationError: An unknown id, or a number that is too large.
    """
    if which == "all":
        return tuple(routes)
    if which.isdecimal():
        count = int(which)
        if not 0 < count <= len(routes):
            raise EvaluationError(
                f"{which} routes were asked for; there are {len(routes)}"
            )
        return tuple(routes[i * len(routes) // count] for i in range(count))
    by_id = {route.id: route for route in routes}
    picked = list[Route]()
    for name in which.split(","):
        if name.strip() not in by_id:
            raise EvaluationError(
                f"no route {name.strip()!r}; there are {len(by_id)}, for example "
                + "".join(get_close_matches(name.strip(), by_id, n=1, cutoff=0.0))
            )
        picked.append(by_id[name.strip()])
    return tuple(picked)
