"""Result of a search on the road: one scheme, and how certain it is."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from me2e_compress.metrics.differences import PairedDifference
from me2e_compress.study.condition import Condition
from me2e_compress.study.on_road.grid import GridPoint
from me2e_compress.study.on_road.halving import Rung, Standing
from me2e_compress.study.on_road.limits import Weighed
from me2e_compress.workflows.budgets import Joules
from me2e_compress.workflows.result import (
    Result,
    Table,
    counted,
    number,
    significant,
    table,
)


@dataclass(frozen=True)
class Scheme:
    """One assignment, apart from how it drives.

    It has no costs if it could not be made; ``refused`` says why it did not drive, and
    ``same_as`` names a scheme with a byte-identical file, if there is one.
    """

    name: str
    point: GridPoint
    weighed: Weighed | None
    refused: str
    same_as: str


@dataclass(frozen=True, repr=False)
class RoadSearchResult(Result):
    """The scheme to ship, and everything that it was chosen by.

    Attributes:
        output: The recipe that was written.
        difference: The winner minus the float model, over all routes.
        device_scale: How many times slower the device is than this machine.
        coverage: Routes that were driven, and those of the whole set.
        spent: Share of each budget that the winner uses, in words.
    """

    output: Path
    schemes: tuple[Scheme, ...]
    float_costs: Weighed
    rungs: tuple[Rung, ...]
    difference: PairedDifference
    joules: Joules
    condition: Condition
    device_scale: float
    coverage: tuple[int, int]
    spent: str

    @property
    def winner(self) -> Scheme:
        """The scheme that the recipe makes."""
        name = self.rungs[-1].standings[0].name
        return next(each for each in self.schemes if each.name == name)

    @property
    def worse_by_at_most(self) -> float | None:
        """Points of driving score: lower end of the two-sided 95 % interval."""
        low = self.difference.driving_score.low
        return None if low is None else max(0.0, -low)

    @property
    def headline(self) -> str:
        """The scheme, and how much worse than float it may be."""
        score, routes = self.difference.driving_score, self.coverage[0]
        mean, most = score.value or 0.0, self.worse_by_at_most
        said = f"this one: {self.winner.name} ({number(mean, '+.1f')} DS); on"
        said += f" {counted(routes, 'route')}"
        if most is None:
            return f"{said} there is no interval: too few routes"
        said += (
            f" it is not worse than float by more than {most:.1f} DS (95 %, two-sided:"
            f" {number(score.low, '+.1f')} to {number(score.high, '+.1f')}, over these"
            " scenario types"
        )
        if score.anew_low is not None:
            said += f"; {max(0.0, -score.anew_low):.1f} over types drawn anew"
        return f"{said})"

    def lines(self) -> tuple[str, ...]:
        """Return the answer, and what it holds for."""
        chosen = len(self.rungs[-1].standings)
        lines = [self.headline, f"budgets: {self.spent}"]
        if chosen > 1:
            lines.append(
                f"chosen as the best of {chosen} on these routes: others may show"
                " a little less"
            )
        if self.coverage[0] < self.coverage[1]:
            lines.append("a preview: {} of {} routes".format(*self.coverage))
        return (*lines, f"{self.output}: {self.winner.name}")

    def tables(self) -> tuple[Table, ...]:
        """Return the grid with its costs, and the rungs."""
        return self._grid(), self._climb()

    def records(self) -> list[dict[str, object]]:
        """Return one row per scheme."""
        return [
            {
                "scheme": each.name,
                "int8": each.point.int8,
                "ablated": each.point.ablated,
                **(asdict(each.weighed) if each.weighed else {}),
                "refused": each.refused or None,
                "routes": max((rung.routes for rung, _ in self._of(each)), default=0),
                "difference": self._last(each),
            }
            for each in self.schemes
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the whole search as JSON."""
        return {
            "winner": self.winner.name,
            "recipe": str(self.output),
            "difference": self.difference.to_json(),
            "worse_by_at_most": self.worse_by_at_most,
            "routes": dict(zip(("driven", "set"), self.coverage, strict=True)),
            "condition": self.condition.to_json(),
            "latency": {"device_scale": self.device_scale},
            "joules": self.joules,
            "float": asdict(self.float_costs),
            "schemes": [self._scheme_json(each) for each in self.schemes],
            "rungs": [asdict(each) for each in self.rungs],
        }

    def _scheme_json(self, scheme: Scheme) -> dict[str, Any]:
        return {
            "name": scheme.name,
            "int8": list(scheme.point.int8),
            "ablated": list(scheme.point.ablated),
            "costs": asdict(scheme.weighed) if scheme.weighed else None,
            "refused": scheme.refused or None,
            "same_as": scheme.same_as or None,
        }

    def _of(self, scheme: Scheme) -> Iterator[tuple[Rung, Standing]]:
        """Yield the standings of a scheme, rung by rung."""
        for rung in self.rungs:
            for standing in rung.standings:
                if standing.name == scheme.name:
                    yield rung, standing

    def _last(self, scheme: Scheme) -> float | None:
        found = [standing.difference for _, standing in self._of(scheme)]
        return found[-1] if found else None

    def _grid(self) -> Table:
        rows = [("float, as it is", *_costs(self.float_costs), "the reference")]
        rows += [
            (each.name, *_costs(each.weighed), self._fate(each))
            for each in self.schemes
        ]
        kind = "measured" if self.joules == "J" else "by published figures"
        note = (
            f"MB of weights; ms: median of a decision, {self.device_scale:.3g} times as"
            f" on this machine; joules a frame {kind}"
        )
        columns = ("scheme", "MB", "ms", self.joules, "outcome")
        return table("Schemes", columns, rows, note)

    def _fate(self, scheme: Scheme) -> str:
        if scheme.refused:
            return scheme.refused
        stood = list(self._of(scheme))
        if not stood:
            return f"the same file as {scheme.same_as}" if scheme.same_as else ""
        rung, standing = stood[-1]
        routes = counted(rung.routes, "route")
        if rung is self.rungs[-1]:
            return "this one" if standing.kept else f"second on {routes}"
        return f"dropped after {routes}, {number(standing.difference, '+.1f')} DS"

    def _climb(self) -> Table:
        rows = [
            (
                str(rung.routes),
                str(len(rung.standings)),
                str(sum(each.kept for each in rung.standings)),
                _said(rung.standings[0]),
                _said([each for each in rung.standings if each.kept][-1]),
            )
            for rung in self.rungs
        ]
        columns = ("routes", "schemes", "kept", "best", "last that was kept")
        note = f"points of driving score against float, paired; {self._conditions()}"
        return table("Rungs", columns, rows, note)

    def _conditions(self) -> str:
        return self.condition.described(f"{self.device_scale:.3g} times as here")


def _costs(weighed: Weighed | None) -> tuple[str, str, str]:
    if weighed is None:
        return ("-", "-", "-")
    return (f"{weighed.mb:.2f}", f"{weighed.ms:.1f}", significant(weighed.joules))


def _said(standing: Standing) -> str:
    return f"{standing.name} {number(standing.difference, '+.1f')}"
