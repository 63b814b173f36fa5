"""Driving efficiency: the ego's speed relative to the traffic around it."""

from collections.abc import Iterator, Sequence
from statistics import fmean

from me2e_compress.metrics.episode import EgoFrame, Ending, Episode
from me2e_compress.metrics.measure import Measure

CHECKPOINTS = 20
OUTLIER_PERCENT = 1000.0
DONE_PERCENT = 95.0
"""Beyond this Bench2Drive also reports the speed over the last stretch."""
PERCENT = "%"


def efficiency(episode: Episode) -> Measure:
    """Return the mean of ego speed over traffic speed at 20 check points, in percent.

    Equation 6: at each check point, every twentieth of the route, the mean ego speed
    since the last one is divided by that of nearby vehicles. Ratios above 1000 % and
    check points without moving traffic are dropped. A route that ends within its first
    5 % has no efficiency.
    """
    ratios = speed_ratios(episode)
    if episode.completion_percent < 100.0 / CHECKPOINTS:
        return Measure(None, PERCENT, "the ego did not pass the first 5 % of the route")
    kept = [ratio for ratio in ratios if ratio <= OUTLIER_PERCENT]
    if not kept:
        return Measure(None, PERCENT, "no check point saw moving traffic")
    return Measure(fmean(kept), PERCENT)


def speed_ratios(episode: Episode) -> tuple[float, ...]:
    """Return the ratio at each check point that saw moving traffic, in percent.

    Ratios reported by the simulator take precedence. Bench2Drive writes the last one
    twice if more than 95 % of the route was passed; it is kept once.
    """
    if episode.speed_ratios_percent is not None:
        given = episode.speed_ratios_percent
        done = episode.completion_percent > DONE_PERCENT
        twice = done and len(given) > 1 and given[-1] == given[-2]
        return given[:-1] if twice else given
    ratios = (_ratio_percent(stretch) for stretch in _stretches(episode))
    return tuple(ratio for ratio in ratios if ratio is not None)


def _stretches(episode: Episode) -> Iterator[list[EgoFrame]]:
    """Yield the frames between two check points."""
    spacing_m = episode.route_length_m / CHECKPOINTS
    passed, stretch = 0, list[EgoFrame]()
    for frame in episode.frames:
        stretch.append(frame)
        reached = int(frame.route_m / spacing_m)
        if reached > passed:
            yield stretch
            passed, stretch = reached, []
    if episode.ending is Ending.COMPLETED and passed < CHECKPOINTS and stretch:
        yield stretch


def beside_traffic(stretch: Sequence[EgoFrame]) -> tuple[float, float, int]:
    """Return summed ego and traffic speeds (m/s) of frames with traffic; how many."""
    seen = [
        (frame.speed_mps, frame.traffic_speed_mps)
        for frame in stretch
        if frame.traffic_speed_mps is not None
    ]
    return sum(ego for ego, _ in seen), sum(other for _, other in seen), len(seen)


def _ratio_percent(stretch: Sequence[EgoFrame]) -> float | None:
    ego, traffic, _ = beside_traffic(stretch)
    return 100.0 * ego / traffic if traffic > 0.0 else None
