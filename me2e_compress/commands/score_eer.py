"""EER_AV of folders of results: driving and energy in one score (equations 8 to 11)."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from me2e_compress.base.display import (
    Table,
    format_number,
    format_significant,
    missing_note,
    plural,
    table,
)
from me2e_compress.base.errors import EvaluationError
from me2e_compress.commands.options import Joules
from me2e_compress.metrics.eer import (
    MEASURES,
    EerResult,
    RouteMeasures,
    eer,
    route_measures,
)
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.runtime.energy import EnergyResult

UNITS = ("%", "%", "ratio", "J")

# Why a route is left out, listed beside the measures that may be missing
UNPAIRED = "a drive in each"


@dataclasses.dataclass(frozen=True)
class EerScores:
    """EER_AV of folders, and their order."""

    result: EerResult

    def tables(self) -> tuple[Table, ...]:
        """Return the scores and their weights."""
        scores, scale = self.result.scores, self.result.scale
        rows = [[n, *estimate_cells(each, ".2f")] for n, each in scores.items()]
        why = missing_note(
            {
                f"EER_AV of {name}": each.measure.reason
                for name, each in scores.items()
                if each.value is None
            }
        )
        columns = ("results", "EER_AV", "95 %", "95 %, other types", "n")
        points = table("Driving and energy, points", columns, rows, why)
        if scale is None:
            return (points,)
        # a measure is scaled so that its offset is 0 and offset plus span is 1
        rows = [
            [name, f"{weight:.3f}", *map(format_significant, (low, low + span)), unit]
            for name, weight, low, span, unit in zip(
                MEASURES, scale.weights, scale.offset, scale.span, UNITS, strict=True
            )
        ]
        left = [f"{n} for want of {name}" for name, n in self.result.left_out.items()]
        note = f"Routes left out of all: {', '.join(left)}." if left else ""
        columns = ("measure", "weight", "0 is", "1 is", "unit")
        return (points, table("Weights by CRITIC, min-max", columns, rows, note))

    def lines(self) -> tuple[str, ...]:
        """Return the order of the folders."""
        if self.result.scale is None:
            return ()
        return (f"EER_AV, best first: {', '.join(self.result.ranking)}",)

    def to_json(self) -> dict[str, Any]:
        """Return scores, scale and routes left out."""
        result = self.result
        columns = {} if result.scale is None else dataclasses.asdict(result.scale)
        scale = {
            n: dict(zip(MEASURES, each, strict=True)) for n, each in columns.items()
        }
        return {
            "scores": result.scores,
            "scale": scale or None,
            "left_out": result.left_out,
        }


def score_eer(
    folders: Mapping[str, Sequence[Episode]], joules: Joules
) -> EerScores | None:
    """Return EER_AV of folders that hold the same routes; None without any joules.

    Raises:
        EvaluationError: Routes differ, or joules are of no folder.
        EnergyError: A file of joules is not usable.
    """
    if not joules:
        return None
    paired, others = paired_drives(folders)
    variants = _variants(paired, joules)
    types = [episode.scenario for episode in next(iter(paired.values()), ())]
    result = eer(variants, types=types)
    if others:
        left_out = {UNPAIRED: others, **result.left_out}
        result = dataclasses.replace(result, left_out=left_out)
    return EerScores(result)


def paired_drives(
    folders: Mapping[str, Sequence[Episode]],
) -> tuple[dict[str, list[Episode]], int]:
    """Return the episodes on shared routes by folder, and the number of other routes.

    The routes are in the first folder's order. Only real runs may lack routes, on which
    CARLA crashed; other folders must hold the same, or EvaluationError is raised.
    """
    by_route = {
        name: {each.route: each for each in episodes}
        for name, episodes in folders.items()
    }
    first = next(iter(by_route.values()), {})
    shared = [each for each in first if all(each in own for own in by_route.values())]
    # differing routes are an error unless every folder is a real run
    real = all(each.given for episodes in folders.values() for each in episodes)
    for name, own in by_route.items():
        unpaired = sorted({*own} ^ {*first})
        if unpaired and not (real and shared):
            raise EvaluationError(
                f"{name}: route {unpaired[0]} is in one of the folders only: EER_AV "
                "compares the same routes"
            )
    # count the routes that not all folders hold
    every = {route for own in by_route.values() for route in own}
    paired = {name: [own[each] for each in shared] for name, own in by_route.items()}
    return paired, len(every) - len(shared)


def _variants(
    folders: Mapping[str, Sequence[Episode]], joules: Joules
) -> dict[str, RouteMeasures]:
    """Measure every folder's routes; joules are a number, or of a file."""
    measured = dict[str, float | None]()
    for name, given in joules.items():
        fitting = [each for each in folders if name in (each, Path(each).name)]
        if len(fitting) != 1:
            raise EvaluationError(
                f"energy of {name}: {plural(len(fitting), 'folder')} of that name;"
                f" there are {', '.join(folders)}"
            )
        if isinstance(given, (str, Path)):
            measured[fitting[0]] = EnergyResult.load(Path(given)).j_per_frame
        elif 0.0 <= given < float("inf"):
            measured[fitting[0]] = given
        else:
            raise EvaluationError(
                f"energy of {name}: {given} is not a number of joules"
            )
    return {
        name: route_measures(list(map(RouteSummary.of, episodes)), measured.get(name))
        for name, episodes in folders.items()
    }


def estimate_cells(estimate: Estimate, form: str) -> tuple[str, str, str, str]:
    """Return a value, its intervals and its number of routes, as a table shows them."""
    if estimate.value is None:
        return "-", "-", "-", str(estimate.n)
    here = _between(estimate.low, estimate.high, form)
    anew = _between(estimate.anew_low, estimate.anew_high, form)
    return format_number(estimate.value, form), here, anew, str(estimate.n)


def _between(low: float | None, high: float | None, form: str) -> str:
    if low is None or high is None:
        return "-"
    return f"{format_number(low, form)} to {format_number(high, form)}"
