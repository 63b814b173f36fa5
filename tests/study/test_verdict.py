import pytest

from me2e_compress.metrics.differences import PairedDifference
from me2e_compress.metrics.measure import Estimate, Measure
from me2e_compress.study.verdict import smallest_shown


def difference(routes: int, low: float | None, high: float | None) -> PairedDifference:
    score = Estimate(Measure(0.0, "points"), low, high, routes)
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
    shown = smallest_shown(difference(routes, low, high))

    assert shown == pytest.approx(least, abs=0.05)
