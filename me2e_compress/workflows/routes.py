"""Make a set of admitted routes."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from me2e_compress.display import counted, table
from me2e_compress.errors import EvaluationError
from me2e_compress.extras import need_extra
from me2e_compress.registry import documents
from me2e_compress.runtime.atomic import write_document
from me2e_compress.simulator.routes import (
    ROAD_VERSION,
    SCENARIO_ABILITIES,
    save_routes,
)
from me2e_compress.version import __version__
from me2e_compress.workflows.checks import writing
from me2e_compress.workflows.options import RoutesOptions
from me2e_compress.workflows.result import SILENT, Listener, Result, Shown

if TYPE_CHECKING:  # they take highway-env, an extra and a second to import
    from me2e_compress.evaluators.highway.generate import ScenarioRoutes


@dataclasses.dataclass(frozen=True, repr=False)
class RoutesResult(Result):
    """A set of routes that was made."""

    output: Path
    harvests: tuple[ScenarioRoutes, ...]

    @property
    def admitted(self) -> int:
        """The number of routes in the set."""
        return sum(len(one.routes) for one in self.harvests)

    @property
    def tried(self) -> int:
        """The number of routes proposed."""
        return sum(one.tried for one in self.harvests)

    def shown(self) -> Shown:
        """Return the routes admitted by scenario, and why others were not."""
        rows = list[tuple[str, ...]]()
        for one in self.harvests:
            # each reason once, with how often it was given if more than once
            reasons = "; ".join(
                f"{reason} ({times} times)" if times > 1 else reason
                for reason, times in Counter(one.refusals).items()
            )
            rows.append((one.scenario, f"{len(one.routes)}", f"{one.tried}", reasons))
        columns = ("scenario", "admitted", "tried", "refused because")
        share = self.admitted / self.tried
        tried = f"{counted(self.tried, 'route')} tried ({share:.0%})"
        return Shown(
            f"{self.admitted} of {tried} -> {self.output}",
            [table("Routes", columns, rows, words=4)],
        )

    def to_json(self) -> object:
        """Return the counts, in all and by scenario."""
        scenarios = [
            {
                "scenario": one.scenario,
                "admitted": len(one.routes),
                "tried": one.tried,
                "refusals": one.refusals,
            }
            for one in self.harvests
        ]
        counts = {"admitted": self.admitted, "tried": self.tried}
        return {**counts, "scenarios": scenarios}


def make_routes(
    output: str | Path,
    options: RoutesOptions | None = None,
    listener: Listener = SILENT,
) -> RoutesResult:
    """Make a fresh set of routes, each admitted by the expert and the blind driver."""
    need_extra("highway", "making routes")
    from me2e_compress.evaluators.highway.generate import ScenarioRoutes, generate

    options, output = options or RoutesOptions(), Path(output)
    types = _scenario_types(options.scenarios)
    deciding = {
        "version": f"{__version__}, road version {ROAD_VERSION}",
        "seed": options.seed,
        "variants": options.variants,
    }
    with writing([output], force=options.force):
        # go on where a run that was killed left off
        draft = output.with_name(f"{output.name}.part")
        begun = list[ScenarioRoutes]()
        if draft.exists():
            with documents.reading(draft, EvaluationError, "not a set that was begun"):
                content = documents.content(draft)
                record = TypeAdapter(dict[str, Any]).validate_json(content)
                for key, wanted in deciding.items():
                    if record.get(key) != wanted:
                        raise EvaluationError(
                            f"{draft}: is a set that was begun with {key}"
                            f" {record.get(key)}, not {wanted}; delete it, or choose"
                            " another name"
                        )
                done = TypeAdapter(list[ScenarioRoutes])
                begun = done.validate_python(record.get("done"))
        harvests = {one.scenario: one for one in begun}
        names = [name for name in types if name not in harvests]
        # keep and report each scenario type as soon as its routes are admitted
        made = generate(options.seed, names, options.variants, options.workers)
        for harvest in made:
            harvests[harvest.scenario] = harvest
            kept = [dataclasses.asdict(one) for one in harvests.values()]
            write_document(draft, deciding | {"done": kept})
            count = len(harvests), len(types)
            listener.on_progress("admitting", *count, harvest.scenario)
        ordered = tuple(harvests[name] for name in types)
        save_routes([route for one in ordered for route in one.routes], output)
        draft.unlink(missing_ok=True)
        return RoutesResult(output, ordered)


def _scenario_types(words: str) -> tuple[str, ...]:
    """Read ``all``, or ``NAME,NAME``."""
    if words == "all":
        return tuple(SCENARIO_ABILITIES)
    names = tuple(name.strip() for name in words.split(","))
    for name in names:
        if name not in SCENARIO_ABILITIES:
            there = ", ".join(sorted(SCENARIO_ABILITIES))
            raise EvaluationError(f"no scenario {name!r}; there are {there}")
    return names
