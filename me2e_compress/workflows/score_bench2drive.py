"""Score the results of real Bench2Drive runs, with what was found beside them."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.bench2drive.real_results import (
    Bench2DriveResults,
    CollectedResults,
)
from me2e_compress.evaluators.bench2drive.records import number_of
from me2e_compress.metrics import scores as metrics
from me2e_compress.metrics.abilities import MEAN, RULES, Rules, ability_rates
from me2e_compress.metrics.comfort import stood_most
from me2e_compress.metrics.episode import LARGEST
from me2e_compress.metrics.leaderboard_scores import (
    VERSIONS,
    LeaderboardScores,
    Quotients,
    Version,
    leaderboard_scores,
)
from me2e_compress.metrics.measure import Measure
from me2e_compress.metrics.scores import Scores
from me2e_compress.registry import documents
from me2e_compress.workflows.result import Table, number, table

STANDING = "the ego stood most of the time, which is comfortable: see comfort in motion"
_NAMED = 5
_TOLERANCE = 1e-6


@dataclasses.dataclass(frozen=True)
class Bench2DriveOptions:
    """How results of real runs are read and scored.

    Attributes:
        metrics: a folder with the recordings (``metric_info.json``), where they do not
            lie below that of the results.
        junctions: JSON file of the share of each route, by its number, at which its
            first junction is passed: (c + 8) / n, as Traffic_Signs asks for it.
        rules: rules of the abilities: ``0.0.3`` or ``0.0.4``; None takes those that
            came with the routes.
        penalties: penalties of infractions: ``b2d``, ``1.0``, ``2.0`` or ``2.1``.
    """

    metrics: str | Path | None = None
    junctions: str | Path | None = None
    rules: Rules | None = None
    penalties: Version = "b2d"

    def __post_init__(self) -> None:
        if self.rules is not None and self.rules not in RULES:
            raise EvaluationError(
                f"no rules {self.rules!r} of abilities; there are {', '.join(RULES)}"
            )
        if self.penalties not in VERSIONS:
            raise EvaluationError(
                f"no penalties {self.penalties!r}; there are {', '.join(VERSIONS)}"
            )


@dataclasses.dataclass(frozen=True)
class RealRun:
    """A real run, scored.

    Attributes:
        scores: scores as of any other run, with Bench2Drive's rules of abilities.
        leaderboard: scores as the leaderboard and Bench2Drive's tools compute them.
        stood: routes on which the ego stood most of its time.
    """

    collected: CollectedResults
    scores: Scores
    leaderboard: LeaderboardScores
    rules: Rules
    stood: tuple[str, ...]

    def tables(self, name: str) -> tuple[Table, ...]:
        """Return the records found, and the scores as given and as computed."""
        return (self._counts(name), self._quotients())

    def alerts(self, name: str) -> Iterator[str]:
        """Yield warnings, one line each."""
        found = self.collected
        if found.route_set is None:
            yield f"{name}: its routes are of no set of Bench2Drive that is known"
        # routes that do not count as they should
        for what, routes in (
            (f"of another set than {found.route_set}", found.foreign),
            (
                "driven more than once with different results, of which the lowest "
                "driving score counts",
                found.contradictory,
            ),
            (STANDING, self.stood),
        ):
            if routes:
                yield f"{name}: {what}: {some_of(routes)}"
        # damaged files, then statements that contradict the records
        for where, reason in list(found.broken.items())[:_NAMED]:
            yield f"{where}: {reason}: left out"
        if len(found.broken) > _NAMED:
            yield f"{name}: broken and left out, too: {len(found.broken) - _NAMED}"
        yield from self._stated()
        if found.off_rate:
            route, interval_s = next(iter(found.off_rate.items()))
            yield (
                f"{name}: not recorded at 20 Hz, so that comfort does not compare with "
                f"others': {len(found.off_rate)} of {len(found.episodes)}, {route} at "
                f"{1 / interval_s:.3g} Hz"
            )
        yield from found.notes[:_NAMED]

    def to_json(self) -> dict[str, object]:
        """Return scores, quotients, and every route that was named."""
        found = self.collected
        return {
            **self.scores.to_json(),
            "leaderboard": {
                "route_set": found.route_set,
                "set_size": self.leaderboard.set_size,
                "rules": self.rules,
                **self.leaderboard.to_json(),
            },
            "records": {
                "evaluated": len(found.episodes),
                **{name: list(each) for name, each in self._named().items()},
                "unfinished": [str(path) for path in found.unfinished],
                "broken": dict(found.broken),
                "intervals_s": dict(found.off_rate),
            },
        }

    def _named(self) -> dict[str, tuple[str, ...]]:
        names = (
            *("crashed", "missing", "foreign", "repeated", "rerun"),
            *("contradictory", "unrecorded"),
        )
        return {n: getattr(self.collected, n) for n in names} | {"stood": self.stood}

    def _stated(self) -> Iterator[str]:
        """Yield where merged files contradict their own records."""
        for path, file in self.collected.stated.items():
            episodes = [each.episode for each in file.records]
            again = leaderboard_scores(episodes)
            rate = again.success_rate.over_set.value
            found = {
                "driving score": again.given_score.over_set.value,
                "success rate": None if rate is None else rate / 100.0,
                "eval num": float(len(episodes)),
            }
            for key, said in file.stated.items():
                value = found[key]
                if value is None or not math.isclose(said, value, abs_tol=_TOLERANCE):
                    yield (
                        f"{path}: it says {key} {said:g}, its records say "
                        f"{number(value, 'g')}"
                    )

    def _counts(self, name: str) -> Table:
        found = self.collected
        rows = [
            ("evaluated", "", str(len(found.episodes))),
            *((key, some_of(of), str(len(of))) for key, of in self._named().items()),
            ("unfinished files", "", str(len(found.unfinished))),
            ("broken", some_of(tuple(found.broken)), str(len(found.broken))),
        ]
        route_set = found.route_set or "of no known set"
        title = f"{name}: real runs, Bench2Drive's routes {route_set}"
        return table(title, ("records", "which", "n"), rows, words=2)

    def _quotients(self) -> Table:
        """Show given and computed figures, each over the set and over the records."""
        of = self.leaderboard
        none = Measure(None, "", "not so")
        nothing = Quotients(none, none)
        # not every figure is both given by the simulator and computed here
        lines = [
            ("driving score", of.given_score, of.score, "%"),
            ("success rate", nothing, of.success_rate, "%"),
            ("route completion", of.given_completion, nothing, "%"),
            ("infraction penalty", of.given_penalty, of.penalty, "ratio"),
        ]
        if of.score != of.score_without_low_speed:
            without = of.score_without_low_speed
            lines.insert(1, ("  without low speed", nothing, without, "%"))
        # each figure is shown over the whole set, and over what was driven
        rows = [
            (label, over, _shown(given, over), _shown(computed, over), str(n), unit)
            for label, given, computed, unit in lines
            for over, n in (("set", of.set_size), ("driven", of.driven))
            if unit == "%" or over == "driven"  # a missing route has no penalty
        ]
        columns = ("score", "over", "given", "computed", "n", "unit")
        title = f"given by the simulator, and computed with penalties {of.penalties}"
        return table(title, columns, rows, words=2)


def score_real_run(path: Path, options: Bench2DriveOptions) -> RealRun:
    """Read and score the results of a real run."""
    metric_folder = None if options.metrics is None else Path(options.metrics)
    # collect the records, and find the rules that came with the routes
    collected = Bench2DriveResults(path, metric_folder).collect()
    episodes = collected.episodes
    set_size = metrics.FULL_SET * collected.repetitions
    rules = options.rules or collected.route_set or RULES[0]
    junctions = _junctions(options.junctions, [each.route for each in episodes])
    # Bench2Drive's rates of abilities replace our own
    rates = ability_rates(episodes, rules, junctions)
    scores = dataclasses.replace(
        metrics.score(episodes, set_size),
        abilities=rates.pop(MEAN),
        each_ability=rates,
    )
    return RealRun(
        collected,
        scores,
        leaderboard_scores(episodes, options.penalties, set_size),
        rules,
        stood_most(episodes),
    )


def _junctions(path: str | Path | None, routes: Sequence[str]) -> dict[str, float]:
    """Read the places of junctions by route; the file names the route or its number."""
    if path is None:
        return {}
    try:
        found = documents.from_json(documents.content(Path(path)))
    except OSError as error:
        raise EvaluationError(f"{path}: cannot be read: {error.strerror}") from error
    except documents.MalformedError as error:
        raise EvaluationError(f"{path}: not JSON: {error}") from error
    if not isinstance(found, Mapping):
        raise EvaluationError(f"{path}: not an object of shares by route")
    for route, share in found.items():
        if type(share) not in (int, float) or not 0.0 < share <= LARGEST:
            raise EvaluationError(f"{path}: {route}: {share!r:.60} is not a share")
    places = {route: found.get(route, found.get(number_of(route))) for route in routes}
    return {route: float(each) for route, each in places.items() if each is not None}


def _shown(quotients: Quotients, over: str) -> str:
    measure = quotients.over_set if over == "set" else quotients.over_driven
    return number(measure.value, ".4f")


def some_of(names: Sequence[str]) -> str:
    """Return the first few of many names."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more
