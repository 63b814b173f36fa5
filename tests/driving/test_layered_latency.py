from typing import Any

import numpy as np
import pytest

from me2e_compress.driving.latency import (
    LATENCY_SOURCES,
    DecisionFacts,
    LatencySource,
    parse_latency,
)
from me2e_compress.driving.layered_latency import AgentsLatency
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.conditions import Conditions
from me2e_compress.testing import check_form

AROUND = np.array([(10.0, 0.0), (0.0, 30.0), (-5.0, 0.0), (60.0, 0.0)])
"""Ahead, to the left, behind, and far ahead."""


def charged(source: LatencySource, facts: DecisionFacts) -> int:
    return source.on_route("r")(facts)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("limited{source=fps:20, fps=10}", 100_000),
        ("limited{source=fps:5, fps=10}", 200_000),
        ("limited{source=measured, fps=10}", 123_000),
    ],
)
def test_a_limiter_charges_the_longer_of_latency_and_period(
    text: str, expected: int
) -> None:
    assert charged(parse_latency(text), DecisionFacts(123_000)) == expected


@pytest.mark.parametrize(
    ("options", "in_view"),
    [({}, 3), ({"fov_deg": 120.0}, 1), ({"range_m": 100.0}, 4), ({"range_m": 9.0}, 1)],
)
def test_agents_in_range_and_view_cost_extra(
    options: dict[str, Any], in_view: int
) -> None:
    source = AgentsLatency(parse_latency("fps:10"), 3_000, **options)

    assert charged(source, DecisionFacts(0, AROUND)) == 100_000 + 3_000 * in_view


def test_a_simulator_that_does_not_tell_where_others_are() -> None:
    source = parse_latency("agents{source=none, per_agent_us=1}")

    with pytest.raises(EvaluationError, match="does not tell where others are"):
        charged(source, DecisionFacts(0))


def test_a_host_stage_is_charged_for_what_it_did() -> None:
    text = "host-stage{source=fps:10, per_iteration_us=500, per_cell_us=10,"
    source = parse_latency(f"{text} per_call_us=2000}}")

    assert charged(source, DecisionFacts(0)) == 100_000
    busy = DecisionFacts(0, host_iterations=12, host_cells=40)
    assert charged(source, busy) == 100_000 + 2_000 + 6_000 + 400


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("limited{source=fps:5, fps=0}", "limited: fps 0 is not a positive number"),
        ("limited{source=often, fps=10}", "no latency source 'often'"),
        ("limited{source=10, fps=10}", "limited: source: Input should be an instance"),
        ("agents{source=none, per_agent_us=-1}", "per_agent_us -1: must be 0 or more"),
        ("agents{source=none, per_agent_us=1, fov_deg=0}", "fov_deg 0: above 0"),
        ("agents{source=none, per_agent_us=1, range_m=inf}", "range_m inf is not a"),
        ("host-stage{source=none, per_iteration_us=-2}", "a cost of -2 us"),
    ],
)
def test_what_makes_no_sense_is_refused_on_one_line(text: str, words: str) -> None:
    with pytest.raises(EvaluationError, match=words) as caught:
        parse_latency(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "limited{source=fps:20, fps=10}",
        "agents{source=limited{source=measured, fps=30}, per_agent_us=3000}",
        "host-stage{source=none, per_iteration_us=5}",
    ],
)
def test_layers_have_the_form_of_a_latency_source(text: str) -> None:
    check_form(LATENCY_SOURCES.parse(text), LATENCY_SOURCES)


def test_options_of_a_trace_reach_it_through_layers() -> None:
    text = "limited{source=agents{source=trace, per_agent_us=1}, fps=10}"
    source = parse_latency(text, in_order=True, scale=2.0, seed=3)

    assert source == parse_latency(
        "limited{source=agents{source=trace{in_order=true, scale=2, seed=3},"
        " per_agent_us=1}, fps=10}"
    )
    assert source.lacks_trace
    assert not source.with_trace((1, 2), 3.0).lacks_trace


def test_an_option_that_the_source_below_has_not_is_refused() -> None:
    with pytest.raises(EvaluationError, match="fps has no option 'in_order'"):
        parse_latency("limited{source=fps:10, fps=5}", in_order=True)


def test_a_layer_on_a_measurement_is_measured() -> None:
    assert parse_latency("limited{source=measured, fps=10}").measures
    assert not parse_latency("limited{source=none, fps=10}").measures


def test_a_trace_without_a_file_is_a_study_s() -> None:
    with pytest.raises(EvaluationError, match=r"names no file \(trace:FILE\)"):
        Conditions(parse_latency("limited{source=trace, fps=10}"))
