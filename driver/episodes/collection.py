"""What a data set is, and the folder that holds it."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.generate import propose, seed_of
from me2e_compress.runtime.atomic import write_json
from me2e_compress.simulator.routes import Route, load_routes
from me2e_compress.simulator.scenarios.catalogue import SCENARIO_ABILITIES

MANIFEST = "dataset.json"
FORMAT = 1
"""Of the episodes; another one cannot go on with a folder."""


@dataclass(frozen=True)
class Collection:
    """A data set: everything that decides its bytes.

    Args:
        seed: Of the routes, the noise and the turns.
        variants: Routes of each type.
        every: Frames of the world (50 ms) between stored samples.
        image_size: Rows and columns of a camera.
        noise: Strength of the perturbation of the driven plan, 0 for none.
        expert_share: Share of 2 s turns in which the expert drives, the student in
            the others; 1 without a student.
        student: sha256 of the student's file, None without one.
        scenarios: The types; empty for all 44.

    Raises:
        EvaluationError: A value is out of range.
    """

    seed: int
    variants: int
    every: int = 4
    image_size: tuple[int, int] = (96, 160)
    noise: float = 1.0
    expert_share: float = 1.0
    student: str | None = None
    scenarios: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the values."""
        for name, value, least in (
            ("seed", self.seed, 0),
            ("variants", self.variants, 1),
            ("every", self.every, 1),
            ("noise", self.noise, 0.0),
        ):
            if not least <= value < float("inf"):
                raise EvaluationError(
                    f"collection: {name} is {value}, it must be at least {least}"
                )
        if not 0.0 <= self.expert_share <= 1.0:
            raise EvaluationError(
                f"collection: expert_share is {self.expert_share}, it must be "
                "between 0 and 1"
            )
        if (self.student is None) != (self.expert_share == 1.0):
            who = "no student" if self.student is None else "a student"
            raise EvaluationError(
                f"collection: expert_share is {self.expert_share} with {who}; it must "
                "be 1 without a student and less with one"
            )


@dataclass(frozen=True)
class Task:
    """One route of a collection, not built yet.

    Args:
        scenario: Its type.
        seed: Of its parameters.
        name: Its id, and the name of its file.
    """

    scenario: str
    seed: int
    name: str

    def route(self) -> Route:
        """Propose the route."""
        return propose(self.scenario, self.seed, self.name)


def tasks_of(what: Collection) -> tuple[Task, ...]:
    """Return all routes of a collection, variant by variant.

    Raises:
        EvaluationError: One of them is a route that ships: those are for judging.
    """
    shipped = {(route.scenario, route.seed): route.id for route in load_routes()}
    tasks = list[Task]()
    for variant in range(what.variants):
        for scenario in what.scenarios or SCENARIO_ABILITIES:
            seed = seed_of(what.seed, scenario, variant)
            if (scenario, seed) in shipped:
                raise EvaluationError(
                    f"collection: seed {what.seed} gives route "
                    f"{shipped[scenario, seed]}, which is for evaluation; choose "
                    "another"
                )
            tasks.append(Task(scenario, seed, f"{scenario}_{what.seed}_{variant:03d}"))
    return tuple(tasks)


def claim(folder: Path, what: Collection) -> None:
    """Make a folder that of a collection, or check that it is.

    Raises:
        EvaluationError: It belongs to another one, holds something else, or cannot be
            written.
    """
    wanted = json.loads(json.dumps({"format": FORMAT, **asdict(what)}))
    manifest = folder / MANIFEST
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not manifest.exists():
            if any(not file.name.startswith(".") for file in folder.iterdir()):
                raise EvaluationError(f"{folder}: not empty, and holds no {MANIFEST}")
            write_json(manifest, wanted, indent=1)
        found = json.loads(manifest.read_bytes())
    except OSError as error:
        raise EvaluationError(f"{folder}: cannot be used: {error.strerror}") from error
    except ValueError as error:
        raise EvaluationError(f"{manifest}: not JSON") from error
    if not isinstance(found, dict):
        raise EvaluationError(f"{manifest}: not a collection")
    for key in sorted({*found, *wanted}):
        if found.get(key) != wanted.get(key):
            raise EvaluationError(
                f"{folder}: holds another collection: its {key} is {found.get(key)}, "
                f"this one's {wanted.get(key)}; choose another folder"
            )
