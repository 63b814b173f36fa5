"""What the drives say about a question: an estimate, and how sure it is."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.paper.cells import Energy, measures_by_variant
from benchmarks.paper.drives import ModelFacts, PaperDrives
from benchmarks.paper.normalizations import Normalization, scored
from benchmarks.paper.questions import PaperQuestion, PAt
from me2e_compress.metrics.episode import InfractionKind
from me2e_compress.metrics.measure import (
    Estimate,
    Floats,
    Measure,
    draw_weights,
    intervals,
    is_a_point,
    mean_estimate,
)
from me2e_compress.metrics.route_summary import COLUMNS, POINTS
from me2e_compress.study.cells import number
from me2e_compress.study.drive_record import DriveRecord

FEWEST_STATIC = 5
"""Collisions with static things below which their shares are not compared: with fewer,
one collision decides."""
FEWEST_RUNS = 5
"""Separated runs of which the medians are compared."""
NOISE = 0.035
"""Share by which the medians of two runs of one file differ, as written down before the
drives (430.1 and 415.2 ms, tag ``road-1``); float and optimizer have 430.2 and 414.6 ms
in ``benchmarks/road_2/paper/variants.json``. Samples of one run tell nothing of it:
their lag-1 autocorrelation is 0.8."""


TRIALS = 20_000
"""Draws for a p-value: thirty tests corrected by Holm ask for small ones."""


@dataclass(frozen=True)
class Found:
    """An estimate, and what decides about it.

    Attributes:
        ways: A value and its p-values by each way to compute it; there is a verdict
            only if all agree.
        notes: What a reader must know beside the number.
        shift: See `PaperQuestion.judge`.
    """

    estimate: Estimate
    ways: tuple[tuple[float, PAt], ...] = ()
    notes: tuple[str, ...] = ()
    shift: float = 0.0


def evidence(question: PaperQuestion, result: PaperDrives, step: float) -> Found:
    """Compute what a question asks for; without an estimate the reason says why.

    ``step`` are the points that one frame of delay more costs.
    """
    drives = [result.drive(*each.split(".")) for each in question.drives]
    why = question.untested or _missing(drives) or _no_tail(question, result)
    if why:
        return Found(Estimate.missing(POINTS, why))
    if question.column in ("ms", "times"):
        return _latency(question, result)
    if question.column == "EER_AV":
        found = _eer(question, result)
    elif question.column == "static":
        found = _static(drives, result.study.seed)
    else:
        found = _difference(question, drives, result.study.seed)
    crossed = _crossed_steps(drives, result) if found.ways else ()
    if not crossed:
        return found
    # what a frame is worth is known of driving scores alone
    known = question.column == "DS"
    crossed += (f"{step:g} points are taken off" if known else "so no verdict",)
    shift = step if known else np.inf
    return Found(found.estimate, found.ways, (*found.notes, *crossed), shift)


def _missing(drives: Sequence[DriveRecord]) -> str:
    """Say why the first drive is missing, if one is."""
    return next((each.reason for each in drives if each.reason), "")


def _no_tail(question: PaperQuestion, result: PaperDrives) -> str:
    """Say that there is no tail, if the question needs one."""
    if question.tail is None:
        return ""
    name = question.of.partition(".")[0]
    fact = result.fact(name)
    most, median = fact.latency_ms(100), fact.latency_ms(50)
    if most is None or median is None:
        return f"no latencies of {name}"
    times = most / median
    if times >= question.tail:
        return ""
    return (
        f"there is no tail: the slowest inference of {name} takes {times:.2f} times its"
        " median"
    )


def _crossed_steps(
    drives: Sequence[DriveRecord], result: PaperDrives
) -> tuple[str, ...]:
    """Name the medians that lie so near a step of equation 4 that noise crosses it."""
    conditions = {each.name: each for each in result.study.conditions}
    found = []
    for each in drives:
        condition = conditions.get(each.condition)
        median = result.fact(each.variant).latency_ms(50)
        if condition is None or not condition.traced or median is None:
            continue
        step = condition.drive.dt_us / 1e3
        edge = step * round(median / step)
        if abs(median - edge) <= NOISE * median:
            found.append(
                f"{each.variant} takes {median:.1f} ms, a step of equation 4 is at"
                f" {edge:.0f}, and runs differ by {100 * NOISE:g} %: a frame may be"
                " noise"
            )
    return tuple(dict.fromkeys(found))


def _difference(
    question: PaperQuestion, drives: Sequence[DriveRecord], seed: int
) -> Found:
    """Return a mean of differences over the routes that all drives have."""
    column = next(e for e in COLUMNS if e.name.removesuffix(" %") == question.column)
    values = [each.values(column) for each in drives]
    gaps = values[0] - values[1]
    if question.bend is not None:
        gaps = (values[1] - values[0]) - (values[2] - values[1])
    estimate = gaps.mean(seed)
    if estimate.value is None:
        return Found(estimate)
    types = [gaps.types[route] for route in gaps.by_route]
    return Found(estimate, (_way(list(gaps.by_route.values()), types, seed),))


def _way(values: Sequence[float], types: Sequence[str], seed: int) -> tuple[float, PAt]:
    """Return the mean of the values of routes, and its p-values over types anew."""
    rows = np.stack([values, np.ones(len(values))], axis=1)
    draws = drawn_anew(rows, types, lambda sums: sums[:, 0] / sums[:, 1], seed)
    return float(rows[:, 0].mean()), partial(p_value, draws)


def drawn_anew(
    rows: Floats, types: Sequence[str], of_sums: Callable[[Floats], Floats], seed: int
) -> Floats:
    """Return a statistic of `TRIALS` sets of types drawn anew, as `intervals` draws.

    Of fewer than two types there are none.

    Args:
        rows: Numbers of each route [routes, k].
        types: The scenario type of each route.
        of_sums: Takes sums over the drawn routes [trials, k], returns [trials].
        seed: The same seed gives the same draws.
    """
    names, type_of = np.unique(np.array(types, str), return_inverse=True)
    if len(names) < 2:
        return np.zeros(0)
    sums = np.zeros((len(names), rows.shape[1]))
    np.add.at(sums, type_of, rows)
    weights = draw_weights(np.random.default_rng(seed), len(names), TRIALS)
    return np.asarray(of_sums(weights @ sums))


def p_value(draws: Floats, edge: float) -> float:
    """Return the two-sided p-value of an edge: below 0.05 as the interval excludes it.

    It is at least 2 / (draws + 1). Draws that all are equal say nothing of what was not
    seen: 1.
    """
    if not len(draws) or is_a_point((float(draws.min()), float(draws.max()))):
        return 1.0
    beyond = min(int((draws <= edge).sum()), int((draws >= edge).sum()))
    return min(1.0, 2.0 * (1 + beyond) / (len(draws) + 1))


def _static(drives: Sequence[DriveRecord], seed: int) -> Found:
    """Return the difference in the share of collisions with static things."""
    counts = np.array([_static_and_all(drive) for drive in drives], np.float64)
    (static, every), (fewer, others) = counts.sum(axis=1).astype(int).tolist()
    if static + fewer < FEWEST_STATIC or not (every and others):
        why = (
            f"too few to compare: {static} of {every} and {fewer} of {others}"
            " collisions are with static things"
        )
        return Found(Estimate.missing("ratio", why))

    rows = np.concatenate(list(counts), axis=1)  # static and all, of both drives

    def gap(sums: Floats) -> Floats:
        one, other = (sums[:, k] / np.maximum(sums[:, k + 1], 1e-9) for k in (0, 2))
        return np.asarray(one - other)

    value = float(gap(rows.sum(axis=0, keepdims=True))[0])
    types = [each.scenario for each in drives[0].routes]
    here, anew = intervals(lambda w: gap(w @ rows), types, seed, value, (-1.0, 1.0))
    estimate = Estimate(Measure(value, "ratio"), *here, len(types), *anew)
    draws = drawn_anew(rows, types, gap, seed)
    return Found(estimate, ((value, partial(p_value, draws)),))


def _static_and_all(drive: DriveRecord) -> list[tuple[int, int]]:
    kinds = [[kind for kind, _ in each.collisions] for each in drive.routes]
    return [(each.count(InfractionKind.COLLISION_LAYOUT), len(each)) for each in kinds]


def _eer(question: PaperQuestion, result: PaperDrives) -> Found:
    """Return the difference in EER_AV, by every normalization.

    It is scored with all of table 5, since scales hang on what is compared; with joules
    of a counter if all have them, otherwise with modelled ones.
    """
    (one, condition), (other, _) = (each.split(".") for each in question.drives)
    block = next((b for b in result.study.blocks if b.name == "table-5"), None)
    names = tuple(dict.fromkeys((*(block.variants if block else ()), one, other)))
    facts = [result.fact(name) for name in names]
    energy: Energy = "measured" if all(f.joules for f in facts) else "modelled"
    variants = measures_by_variant(result, names, energy, condition)
    ways_scored = scored(variants)
    for found in ways_scored.values():
        for name in (one, other):
            if name not in found.routes:
                return Found(found.scores[name])
    first, seed = ways_scored[Normalization.MIN_MAX], result.study.seed
    # the types of the routes that all normalizations keep
    types = [each.scenario for each in result.drive(one, condition).routes]
    kinds = [kind for kind, kept in zip(types, first.is_scored, strict=True) if kept]
    gaps = {
        each: (found.routes[one] - found.routes[other]).tolist()
        for each, found in ways_scored.items()
    }
    ways = {each: _way(values, kinds, seed) for each, values in gaps.items()}
    estimate = mean_estimate(gaps[Normalization.MIN_MAX], kinds, POINTS, seed)
    # what a reader must know of the one number
    notes = [f"energy is {energy}"]
    if first.left_out:
        gone = ", ".join(f"{count} have no {m}" for m, count in first.left_out.items())
        notes.append(f"{len(kinds)} of {len(types)} routes: {gone}")
    by = ", ".join(f"{number(value, '+.1f')} {n}" for n, (value, _) in ways.items())
    return Found(estimate, tuple(ways.values()), (*notes, by))


def _latency(question: PaperQuestion, result: PaperDrives) -> Found:
    """Compare medians of runs that were made in turn, by Student's t over the runs."""
    from scipy import stats  # takes a second to import

    one, other = (result.fact(each.split(".")[0]) for each in question.drives)
    runs = [np.array(each.runs_us, np.float64) / 1e3 for each in (one, other)]
    fewest = min(len(each) for each in runs)
    if fewest < FEWEST_RUNS:
        why = (
            f"{_medians(one)} and {_medians(other)}: medians of {FEWEST_RUNS} separated"
            f" runs decide, since two runs of one file differ by {100 * NOISE:g} %"
        )
        return Found(Estimate.missing("ms", why))
    times = question.column == "times"
    first, second = (np.log(each) if times else each for each in runs)
    gaps = first[:fewest] - second[:fewest]
    mean, error = float(gaps.mean()), float(gaps.std(ddof=1)) / len(gaps) ** 0.5
    reach = float(stats.t.ppf(0.975, len(gaps) - 1)) * error

    def p_at(edge: float) -> float:
        t = abs(mean - (math.log(edge) if times else edge)) / max(error, 1e-12)
        return float(2.0 * stats.t.sf(t, len(gaps) - 1))

    ends = (mean, mean - reach, mean + reach)
    value, low, high = (math.exp(each) for each in ends) if times else ends
    measure = Measure(value, "times" if times else "ms")
    return Found(Estimate(measure, None, None, fewest, low, high), ((value, p_at),))


def _medians(fact: ModelFacts) -> str:
    median = fact.latency_ms(50)
    known = "no latency" if median is None else f"{median:.1f} ms"
    return f"{fact.variant} {known} in one run"
