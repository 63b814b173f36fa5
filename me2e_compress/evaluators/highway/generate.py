"""Generate routes: proposed by scenario types, admitted by the gate."""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.admission import examine
from me2e_compress.runtime.children import pool
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scenarios.builders import stage_of
from me2e_compress.simulator.scenarios.catalogue import SCENARIO_ABILITIES, VARIANTS

MOST_TRIES = 8
"""Most proposals of a type per wanted route."""


@dataclass(frozen=True)
class ScenarioRoutes:
    """Admitted routes of one scenario type, and why others were refused."""

    scenario: str
    routes: tuple[Route, ...]
    refusals: tuple[str, ...]

    @property
    def tried(self) -> int:
        """Number of proposals that were put through the gate."""
        return len(self.routes) + len(self.refusals)


def propose(scenario: str, seed: int, name: str) -> Route:
    """Return a route of one of the 44 types, with every parameter written out."""
    known = SCENARIO_ABILITIES.get(scenario)
    if known is None:
        there = ", ".join(sorted(SCENARIO_ABILITIES))
        raise EvaluationError(f"no scenario {scenario!r}; there are {there}")
    route = Route(name, scenario, known[0], seed)
    return replace(route, parameters=dict(stage_of(route).parameters))


def seed_of(seed: int, scenario: str, attempt: int) -> int:
    """Return the seed of the n-th proposal of a type, different for every type."""
    words = [seed, zlib.crc32(scenario.encode()), attempt]
    return int(np.random.SeedSequence(words).generate_state(1)[0])


def admitted_routes(
    scenario: str, seed: int, variants: int = VARIANTS
) -> ScenarioRoutes:
    """Propose routes of a type until enough are admitted."""
    routes, refusals = list[Route](), list[str]()
    for attempt in range(MOST_TRIES * variants):
        name = f"{scenario}_{len(routes)}"
        verdict = examine(propose(scenario, seed_of(seed, scenario, attempt), name))
        if verdict.refusal is None:
            routes.append(verdict.route)
        else:
            refusals.append(verdict.refusal)
        if len(routes) == variants:
            return ScenarioRoutes(scenario, tuple(routes), tuple(refusals))
    raise EvaluationError(
        f"{scenario}: {len(routes)} of {variants} routes after {len(refusals)} "
        f"refusals with seed {seed}; the last: {refusals[-1] if refusals else 'none'}"
    )


def generate(
    seed: int,
    scenarios: Sequence[str] = tuple(SCENARIO_ABILITIES),
    variants: int = VARIANTS,
    workers: int = 1,
) -> Iterator[ScenarioRoutes]:
    """Generate routes of several types, in order, whatever the number of workers."""
    of_type = partial(admitted_routes, seed=seed, variants=variants)
    if workers == 1:
        yield from map(of_type, scenarios)
        return
    with pool(workers) as processes:
        yield from processes.map(of_type, scenarios)
