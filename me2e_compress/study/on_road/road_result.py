"""Result of a search on the road: one scheme, and how certain it is."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from me2e_compress.metrics.differences import PairedDifference
from me2e_compress.study.on_road.grid import GridPoint
from me2e_compress.study.on_road.halving import Rung, Standing
from me2e_compress.study.on_road.road_drives import RoadDrives
from me2e_compress.study.on_road.road_options import Limits, Weighed
from me2e_compress.workflows.result import (
    Result,
    Table,
    counted,
    number,
    significant,
    table,
)


@dataclass(frozen=True, repr=False)
class RoadSearchResult(Result):
    """The scheme to ship, and everything that it was chosen by.

    Attributes:
        output: The recipe that was written.
        grid: The schemes by name.
        made: Their files, with what they cost.
        difference: The winner minus the float model, over all routes.
    """

    output: Path
    limits: Limits
    grid: Mapping[str, GridPoint]
    made: RoadDrives
    rungs: tuple[Rung, ...]
    difference: PairedDifference

    @property
    def winner(self) -> str:
        """The scheme that the recipe makes."""
        return self.rungs[-1].standings[0].name

    @property
    def coverage(self) -> tuple[int, int]:
        """Routes that were driven, and those of the whole set."""
        return len(self.made.study.routes), self.made.study.set_size

    @property
    def device_scale(self) -> float:
        """How many times slower the device is than this machine."""
        return self.made.setup.clock.scale

    def refused(self, scheme: str) -> str:
        """Say why a scheme did not drive; empty if it might have."""
        made = self.made
        if scheme in made.failures:
            return f"not made: {made.failures[scheme]}"
        if self.limits.spent(made.weighed[scheme]) <= 1:
            return ""
        return f"over budget: {self._spent(scheme)}"

    def _spent(self, scheme: str) -> str:
        return self.limits.words(self.made.weighed[scheme], self.made.joules)

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
        said = f"this one: {self.winner} ({number(mean, '+.1f')} DS); on"
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
        budgets = f"budgets: {self._spent(self.winner)}"
        lines = [self.headline, budgets, self._room()]
        if chosen > 1:
            lines.append(
                f"chosen as the best of {chosen} on these routes: others may show"
                " a little less"
            )
        if self.coverage[0] < self.coverage[1]:
            lines.append("a preview: {} of {} routes".format(*self.coverage))
        return (*lines, f"{self.output}: {self.winner}")

    def _room(self) -> str:
        room = self.difference.room_kept
        if room.value is None:
            return f"room kept to others: not measured ({room.measure.reason})"
        value, low, high = (
            number(e, "+.1f") for e in (room.value, room.low, room.high)
        )
        return f"room kept to others: {value} points (95 %: {low} to {high})"

    def tables(self) -> tuple[Table, ...]:
        """Return the grid with its costs, and the rungs."""
        return self._grid(), self._climb()

    def records(self) -> list[dict[str, object]]:
        """Return one row per scheme."""
        return [
            {
                "scheme": name,
                "int8": point.int8,
                "ablated": point.ablated,
                **(self._costs_json(name) or {}),
                "refused": self.refused(name) or None,
                "routes": max((rung.routes for rung, _ in self._of(name)), default=0),
                "difference": self._last(name),
            }
            for name, point in self.grid.items()
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the whole search as JSON."""
        return {
            "winner": self.winner,
            "recipe": str(self.output),
            "difference": self.difference.to_json(),
            "worse_by_at_most": self.worse_by_at_most,
            "routes": dict(zip(("driven", "set"), self.coverage, strict=True)),
            "condition": self.made.study.conditions[0].to_json(),
            "latency": {"device_scale": self.device_scale},
            "joules": self.made.joules,
            "float": self._costs_json(self.made.study.baseline),
            "schemes": [self._scheme_json(each) for each in self.grid],
            "rungs": [asdict(each) for each in self.rungs],
        }

    def _scheme_json(self, scheme: str) -> dict[str, Any]:
        return {
            "name": scheme,
            "int8": list(self.grid[scheme].int8),
            "ablated": list(self.grid[scheme].ablated),
            "costs": self._costs_json(scheme),
            "refused": self.refused(scheme) or None,
            "same_as": self.made.same_as(scheme) or None,
        }

    def _costs_json(self, scheme: str) -> dict[str, float] | None:
        weighed = self.made.weighed.get(scheme)
        return None if weighed is None else asdict(weighed)

    def _of(self, scheme: str) -> Iterator[tuple[Rung, Standing]]:
        """Yield the standings of a scheme, rung by rung."""
        for rung in self.rungs:
            for standing in rung.standings:
                if standing.name == scheme:
                    yield rung, standing

    def _last(self, scheme: str) -> float | None:
        found = [standing.difference for _, standing in self._of(scheme)]
        return found[-1] if found else None

    def _grid(self) -> Table:
        weighed, joules = self.made.weighed, self.made.joules
        whole = weighed[self.made.study.baseline]
        rows = [("float, as it is", *_costs(whole), "the reference")]
        rows += [
            (name, *_costs(weighed.get(name)), self._fate(name)) for name in self.grid
        ]
        kind = "measured" if joules == "J" else "by published figures"
        note = (
            f"MB of weights; ms: median of a decision, {self.device_scale:.3g} times as"
            f" on this machine; joules a frame {kind}"
        )
        columns = ("scheme", "MB", "ms", joules, "outcome")
        return table("Schemes", columns, rows, note)

    def _fate(self, scheme: str) -> str:
        if refused := self.refused(scheme):
            return refused
        stood = list(self._of(scheme))
        if not stood:
            same = self.made.same_as(scheme)
            return f"the same file as {same}" if same else ""
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
        device = f"{self.device_scale:.3g} times as here"
        condition = self.made.study.conditions[0].described(device)
        note = f"points of driving score against float, paired; {condition}"
        return table("Rungs", columns, rows, note)


def _costs(weighed: Weighed | None) -> tuple[str, str, str]:
    if weighed is None:
        return ("-", "-", "-")
    return (f"{weighed.mb:.2f}", f"{weighed.ms:.1f}", significant(weighed.joules))


def _said(standing: Standing) -> str:
    return f"{standing.name} {number(standing.difference, '+.1f')}"
