"""Score the results of real Bench2Drive runs, with what was found beside them."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from me2e_compress.evaluators.bench2drive.real_results import (
    Bench2DriveResults,
    CollectedResults,
)
from me2e_compress.metrics import scores as metrics
from me2e_compress.metrics.measure import Measure
from me2e_compress.metrics.route_scores import stood_most
from me2e_compress.metrics.scores import (
    LeaderboardScores,
    Quotients,
    Scores,
    leaderboard_scores,
)
from me2e_compress.workflows.result import Table, number, table

STANDING = "the ego stood most of the time, which is comfortable: see comfort in motion"
_NAMED = 5
_TOLERANCE = 1e-6


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
        # each figure is shown over the whole set, and over what was driven
        rows = [
            (label, over, _shown(given, over), _shown(computed, over), str(n), unit)
            for label, given, computed, unit in lines
            for over, n in (("set", of.set_size), ("driven", of.driven))
            if unit == "%" or over == "driven"  # a missing route has no penalty
        ]
        columns = ("score", "over", "given", "computed", "n", "unit")
        title = "given by the simulator, and computed with Bench2Drive's penalties"
        return table(title, columns, rows, words=2)


def score_real_run(path: Path, metric_folder: Path | None = None) -> RealRun:
    """Read and score the results of a real run.

    `metric_folder` holds recordings (``metric_info.json``) that do not lie below that
    of the results.
    """
    collected = Bench2DriveResults(path, metric_folder).collect()
    episodes = collected.episodes
    set_size = metrics.FULL_SET * collected.repetitions
    return RealRun(
        collected,
        metrics.score(episodes, set_size),
        leaderboard_scores(episodes, set_size),
        stood_most(episodes),
    )


def _shown(quotients: Quotients, over: str) -> str:
    measure = quotients.over_set if over == "set" else quotients.over_driven
    return number(measure.value, ".4f")


def some_of(names: Sequence[str]) -> str:
    """Return the first few of many names."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more
