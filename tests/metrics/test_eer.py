"""EER_AV against a hand-worked example, and what it must not depend on."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from me2e_compress.base.errors import EvaluationError
from me2e_compress.metrics.eer import (
    EerScale,
    RouteMeasures,
    critic_weights,
    eer,
    route_measures,
)
from me2e_compress.metrics.episode import Ending, Episode, Given, InfractionKind
from me2e_compress.metrics.route_summary import RouteSummary
from tests.metrics.drives import cruise, drive, infraction


def measured(episodes: Sequence[Episode], j_per_frame: float | None) -> RouteMeasures:
    return route_measures(
        [RouteSummary.of(episode) for episode in episodes], j_per_frame
    )


def measures(*rows: tuple[float, float, float, float], crashed: str) -> RouteMeasures:
    """Rows of DS, DE, DC and joules; an ``x`` for every route with a collision."""
    hits = np.array([letter == "x" for letter in crashed])
    return RouteMeasures(np.array(rows, np.float64), hits)


BY_HAND = {
    "a": measures((100, 100, 1.0, 10), (60, 80, 0.5, 10), crashed=".."),
    "b": measures((100, 120, 0.5, 5), (40, 80, 0.0, 5), crashed=".x"),
}
EQUAL = EerScale(
    weights=(0.25, 0.25, 0.25, 0.25),
    offset=(40.0, 80.0, 0.0, 5.0),
    span=(60.0, 40.0, 1.0, 5.0),
)
NAN = math.nan

routes = arrays(np.float64, (5, 4), elements=st.floats(0, 100, width=16))


def of_table(table: np.ndarray) -> RouteMeasures:
    return RouteMeasures(table, table[:, 0] < 50.0)


def test_the_example_by_hand() -> None:
    result = eer(BY_HAND, EQUAL)

    assert result.routes["a"] == pytest.approx([100 * 3 / 8, -100 / 24])
    assert result.routes["b"] == pytest.approx([100 * 5 / 8, 0.0])
    assert result.scores["a"].value == pytest.approx(100 / 6)
    assert result.scores["b"].value == pytest.approx(31.25)
    assert result.scores["b"].measure.unit == "points"
    assert result.ranking == ("b", "a")


def test_a_collision_leaves_the_driving_score_alone() -> None:
    """Half of everything: (1/2) / 4, and not (1/2 + 1/2 + 1/2 - 1/2) / 4."""
    half = (70, 100, 0.5, 7.5)

    result = eer({"a": measures(half, half, crashed="x.")}, EQUAL)

    assert result.routes["a"] == pytest.approx([100 / 8, 100 / 4])


def test_the_scale_is_of_all_routes_and_used_again_on_another_variant() -> None:
    result = eer(BY_HAND)

    assert result.scale is not None
    assert (result.scale.offset, result.scale.span) == (EQUAL.offset, EQUAL.span)
    assert sum(result.scale.weights) == pytest.approx(1.0)
    alone = eer({"b": BY_HAND["b"]}, result.scale)
    assert alone.routes["b"] == pytest.approx(result.routes["b"])


def test_weights_come_from_critic_over_routes_and_variants() -> None:
    scale = eer(BY_HAND).scale

    # normalized: DS 1 1/3 1 0, DE 1/2 0 1 0, DC 1 1/2 1/2 0, E 1 1 0 0
    x = np.array([[1, 1 / 3, 1, 0], [0.5, 0, 1, 0], [1, 0.5, 0.5, 0], [1, 1, 0, 0]])
    content = x.std(axis=1) * (1 - np.abs(np.corrcoef(x))).sum(axis=1)
    assert scale is not None
    assert scale.weights == pytest.approx(content / content.sum())


@pytest.mark.parametrize("measure", range(4))
def test_a_missing_measure_is_named_and_the_others_are_scored(measure: int) -> None:
    table = BY_HAND["a"].table.copy()
    table[:, measure] = NAN
    lacking = RouteMeasures(table, BY_HAND["a"].crashed)

    result = eer({**BY_HAND, "c": lacking})

    names = ("driving score", "efficiency", "comfort", "energy")
    assert result.scores["c"].measure.reason == f"{names[measure]}: not measured"
    assert result.scores["a"] == eer(BY_HAND).scores["a"]


def test_a_route_that_one_variant_did_not_measure_is_left_out_of_all() -> None:
    more = {
        "a": measures(*BY_HAND["a"].table.tolist(), (10, NAN, 0.5, 10), crashed="..."),
        "b": measures(*BY_HAND["b"].table.tolist(), (90, 90, 0.9, 1), crashed=".x."),
    }

    result = eer(more)

    assert result.left_out == {"efficiency": 1}
    assert result.scores["b"] == eer(BY_HAND).scores["b"]


def test_variants_that_measure_the_same_have_no_weights() -> None:
    same = measures((50, 50, 0.5, 5), (50, 50, 0.5, 5), crashed="..")

    result = eer({"a": same, "b": same}).scores["a"]

    assert result.value is None
    assert "CRITIC finds no weights" in result.measure.reason


def test_unequal_routes_are_refused() -> None:
    with pytest.raises(EvaluationError, match="the same routes"):
        eer({**BY_HAND, "c": measures((1, 1, 1, 1), crashed=".")})


@given(routes, routes, st.sampled_from([1e-3, 0.5, 8.0]), st.permutations(range(5)))
def test_neither_units_nor_the_order_of_routes_change_a_score(
    one: np.ndarray, other: np.ndarray, unit: float, order: list[int]
) -> None:
    result = eer({"a": of_table(one), "b": of_table(other)})
    first, second = (table[order] * (1.0, 1.0, 1.0, unit) for table in (one, other))
    moved = eer({"a": of_table(first), "b": of_table(second)})

    for name, score in result.scores.items():
        again = moved.scores[name]
        assert score.n == again.n
        assert score.value == pytest.approx(again.value, abs=1e-6)


def test_joules_of_a_route_are_those_of_its_decisions() -> None:
    """Without a log of them, as of a real run, each recorded step is one."""
    result = measured([drive(driven=cruise(traffic=5.0))], 2.5)
    reported, eight = Given("Completed", 100.0, 1.0, 100.0), drive(driven=cruise()[:8])
    real = dataclasses.replace(eight, decisions=(), given=reported)

    assert np.isnan(measured([drive()], None).table[0, 3])
    # a drive by hand has one decision
    assert result.table.tolist() == [pytest.approx([100.0, 200.0, 1.0, 2.5])]
    assert measured([real], 2.5).table[0, 3] == 20.0


def test_a_driver_that_failed_at_once_is_not_left_out() -> None:
    stuck = drive(completion=1.0, driven=cruise(1.0), ending=Ending.TIMEOUT)
    result = measured([stuck], 1.0)

    assert result.table[0, 1:3].tolist() == [0.0, 0.0]


def test_without_a_record_nothing_is_made_up() -> None:
    hit = infraction(InfractionKind.COLLISION_VEHICLE)
    silent = dataclasses.replace(drive(hit, completion=2.0), decisions=())
    result = measured([silent], 1.0)

    assert np.isnan(result.table[0, 1:]).all()
    assert result.crashed.tolist() == [True]


@pytest.mark.parametrize("kind", InfractionKind)
def test_of_all_infractions_a_collision_alone_is_a_crash(kind: InfractionKind) -> None:
    result = measured([drive(infraction(kind, 50.0)), drive()], 1.0)

    assert result.crashed.tolist() == [kind.name.startswith("COLLISION"), False]


# CRITIC against a hand-worked example, and what must not change its weights.


ROWS = np.array([[0, 0, 0], [0, 1, 1], [1, 1, 0], [1, 1, 1]], np.float64)
tables = arrays(np.float64, (6, 4), elements=st.floats(0, 1, width=16))


def weights_of(rows: np.ndarray) -> np.ndarray | None:
    try:
        return critic_weights(rows)
    except EvaluationError:
        return None


@pytest.mark.parametrize("unit", [1e-15, 1e15])
def test_the_unit_of_all_measures_does_not_matter(unit: float) -> None:
    assert critic_weights(unit * ROWS) == pytest.approx(critic_weights(ROWS))


def test_the_example_by_hand_beside_a_constant_that_weighs_nothing() -> None:
    outer, middle = (2 - 1 / math.sqrt(3)) / 2, (math.sqrt(3) - 1) / 2
    contents = np.array([outer, middle, outer])

    result = critic_weights(np.hstack([np.full((4, 1), 0.7), ROWS]))

    assert critic_weights(ROWS) == pytest.approx(contents / contents.sum())
    assert result[0] == 0.0
    assert result[1:] == pytest.approx(critic_weights(ROWS))


@pytest.mark.parametrize(
    ("rows", "vary"),
    [
        (np.ones((4, 3)), 0),
        (np.array([[0.0, 1.0], [1.0, 1.0]]), 1),
        (np.array([[0.0, 3.0], [1.0, 1.0], [0.5, 2.0]]), 2),
        (np.ones((1, 4)), 0),
    ],
)
def test_measures_that_say_the_same_have_no_weights(
    rows: np.ndarray, vary: int
) -> None:
    with pytest.raises(EvaluationError, match=f"rows {vary} vary"):
        critic_weights(rows)


@given(tables, st.permutations(range(6)))
def test_neither_the_order_of_rows_nor_a_sign_nor_an_offset_matters(
    rows: np.ndarray, order: list[int]
) -> None:
    result, other = weights_of(rows), weights_of(1.0 - rows[order])

    assert (result is None) == (other is None)
    if result is not None and other is not None:
        assert result == pytest.approx(other, abs=1e-6)
        assert result.sum() == pytest.approx(1.0)
        assert (result >= 0.0).all()
