"""What a data set is, and the folder that holds it."""

from collections.abc import Iterable
from dataclasses import dataclass

from me2e_compress.evaluators.highway.driven_frames import propose, seed_of
from me2e_compress.simulator.routes import SCENARIO_ABILITIES, Route, load_routes
from models.driver.errors import TrainingError

MANIFEST = "dataset.json"
FORMAT = 2
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
        TrainingError: A value is out of range.
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
                raise TrainingError(
                    f"collection: {name} is {value}, it must be at least {least}"
                )
        if not 0.0 <= self.expert_share <= 1.0:
            raise TrainingError(
                f"collection: expert_share is {self.expert_share}, it must be "
                "between 0 and 1"
            )
        if (self.student is None) != (self.expert_share == 1.0):
            who = "no student" if self.student is None else "a student"
            raise TrainingError(
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
        TrainingError: One of them is a route that ships: those are for judging.
    """
    tasks = tuple(
        Task(scenario, seed, f"{scenario}_{what.seed}_{variant:03d}")
        for variant in range(what.variants)
        for scenario in what.scenarios or SCENARIO_ABILITIES
        for seed in (seed_of(what.seed, scenario, variant),)
    )
    refuse_shipped("collection", what.seed, [(e.scenario, e.seed) for e in tasks])
    return tasks


def refuse_shipped(what: str, seed: int, routes: Iterable[tuple[str, int]]) -> None:
    """Refuse types and seeds of routes that ship.

    Raises:
        TrainingError: one of them is such a route: those are for evaluation.
    """
    shipped = {(route.scenario, route.seed): route.id for route in load_routes()}
    for each in routes:
        if each in shipped:
            raise TrainingError(
                f"{what}: seed {seed} gives route {shipped[each]}, which is for"
                " evaluation; choose another"
            )
