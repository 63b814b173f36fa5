import pytest

from me2e_compress.metrics.differences import PairedDifference
from me2e_compress.metrics.measure import Estimate, Measure


def paired(
    routes: int, low: float | None, high: float | None, value: float = 0.0
) -> PairedDifference:
    score = Estimate(Measure(value, "points"), low, high, routes)
    return PairedDifference(score, score, 0, 0)


@pytest.mark.parametrize(
    ("routes", "low", "high", "least"),
    [
        (220, -1.0, 1.0, 1.6),
        (5, 0.0, 0.0, 10.5),  # all alike: five routes show little nevertheless
        (5, -0.3, 40.6, 20.45),
        (1, None, None, 23.5),
    ],
)
def test_few_routes_show_only_large_differences(
    routes: int, low: float | None, high: float | None, least: float
) -> None:
    assert paired(routes, low, high).smallest_shown == pytest.approx(least, abs=0.05)


@pytest.mark.parametrize(
    ("routes", "low", "high", "value", "said"),
    [
        (220, 0.7, 6.7, 3.7, "better"),
        (220, -6.7, -0.7, -3.7, "worse"),
        (220, -0.9, 5.6, 2.3, "no difference shown"),
        (220, 0.2, 1.8, 1.0, "too few routes"),  # below the 1.6 that 220 show
        (4, 1.0, 20.0, 11.0, "too few routes"),
        (1, None, None, 60.0, "too few routes"),
        (220, 0.04, 4.0, 2.0, "no difference shown"),  # shown as 0.0
    ],
)
def test_a_verdict_asks_for_the_interval_and_for_enough_routes(
    routes: int, low: float | None, high: float | None, value: float, said: str
) -> None:
    assert paired(routes, low, high, value).verdict == said
