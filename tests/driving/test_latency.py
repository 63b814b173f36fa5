import json
from collections.abc import Callable
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.latency import (
    LATENCY_SOURCES,
    DecisionFacts,
    FrameRate,
    LatencySource,
    MeasuredLatency,
    NoLatency,
    TraceLatency,
    parse_latency,
    with_draws,
)
from me2e_compress.driving.realtime import (
    ControlClock,
    LatencyModel,
    delayed_frames,
    skipped_decisions,
)
from me2e_compress.evaluators import Drive
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.testing import check_form

SAMPLES = (10_000, 20_000, 70_000)
NOTHING = DecisionFacts(0)


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    path = tmp_path / "trace.json"
    LatencyTrace("abc", "a bench", SAMPLES).save(path)
    return path


def charges(source: LatencySource, route: str, count: int = 60) -> list[int]:
    charge = source.on_route(route)
    return [charge(DecisionFacts(123)) for _ in range(count)]


def test_a_frame_rate_charges_its_period_a_measurement_itself_and_none_nothing() -> (
    None
):
    assert charges(parse_latency("fps:10"), "r", 2) == [100_000, 100_000]
    assert charges(parse_latency(f"fps:{1 / 0.15}"), "r", 1) == [150_000]
    assert parse_latency("none") == NoLatency()
    source = parse_latency("measured{scale=3}")
    assert source == MeasuredLatency(3.0)
    assert source.measures
    assert charges(source, "r", 1) == [369]


def test_a_trace_in_order_starts_over_on_every_route(trace: Path) -> None:
    source = parse_latency(f"trace{{trace={trace}, in_order=true, scale=2}}")

    for route in ("a", "b"):
        assert charges(source, route, 4) == [20_000, 40_000, 140_000, 20_000]


def test_a_trace_is_drawn_by_seed_and_route(trace: Path) -> None:
    source = parse_latency(f"trace:{trace}", seed=1)
    first = charges(source, "a")

    assert set(first) == set(SAMPLES)
    assert first == charges(source, "a")
    assert first != charges(source, "b")
    assert first != charges(parse_latency(f"trace:{trace}", seed=2), "a")
    assert parse_latency("fps:10", seed=3) == FrameRate(10.0)  # draws nothing


def test_a_negative_seed_is_refused_before_anything_drives(trace: Path) -> None:
    with pytest.raises(EvaluationError, match="trace: seed: Input should be"):
        with_draws(TraceLatency(trace), -1)


def test_a_route_does_not_depend_on_what_drove_before() -> None:
    source = TraceLatency(SAMPLES)
    alone = charges(source, "a")
    one, other = source.on_route("b"), source.on_route("a")

    mixed = [(one(NOTHING), other(NOTHING))[1] for _ in range(60)]

    assert mixed == alone


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fps:0", "fps: fps: Input should be greater than 0"),
        ("fps:-3", "fps: fps: Input should be greater than 0"),
        ("fps:ten", "fps: fps: Input should be a valid number"),
        ("fps:nan", "fps: fps: Input should be"),
        ("fps:", "a value is expected behind fps:"),
        ("10", "no latency source '10'; there are none, fps"),
        ("trace:/no/such/file", "No such file"),
        ("none{scale=2}", "none has no option 'scale'; it has none"),
        ("fps{fps=10, scale=2}", "fps has no option 'scale'; it has fps"),
        ("measured{in_order=true}", "measured has no option 'in_order'"),
        *(
            (f"measured{{scale={scale}}}", "scale")
            for scale in ("0", "-1", "inf", "nan")
        ),
        ("limited{source=fps:5, fps=0}", "limited: fps: Input should be greater"),
        ("limited{source=often, fps=10}", "no latency source 'often'"),
        ("limited{source=10, fps=10}", "limited: source: Input should be an instance"),
        ("agents{source=none, per_agent_us=1}", "no latency source 'agents'"),
        ("host-stage{source=none, per_iteration_us=-2}", "greater than or equal"),
    ],
)
def test_other_words_are_refused_on_one_line(text: str, words: str) -> None:
    with pytest.raises(EvaluationError, match=words) as caught:
        parse_latency(text)
    assert "\n" not in str(caught.value)


def test_a_trace_comes_back_and_its_percentiles_are_samples(trace: Path) -> None:
    record = LatencyTrace("abc", "a bench", tuple(range(1, 101))).to_json()

    assert LatencyTrace.load(trace) == LatencyTrace("abc", "a bench", SAMPLES)
    assert [record[f"p{p}_us"] for p in (50, 90, 99)] == [50, 90, 99]
    assert record["max_us"] == 100
    # sources say how many samples they have
    layered = parse_latency(f"limited{{source=trace:{trace}, fps=10}}")
    assert parse_latency(f"trace:{trace}").measured == layered.measured == len(SAMPLES)
    assert parse_latency("trace").measured is parse_latency("fps:10").measured is None


@pytest.mark.parametrize("content", ["", "[]", [], [-1], [1.5]])
def test_another_file_is_no_trace(tmp_path: Path, content: object) -> None:
    path = tmp_path / "trace.json"
    record = {"model_sha256": "a", "machine": "b", "samples_us": content}
    path.write_text(content if isinstance(content, str) else json.dumps(record))

    with pytest.raises(EvaluationError, match=r"trace.json: not a latency trace"):
        LatencyTrace.load(path)


def test_the_fingerprint_of_a_trace_is_its_samples() -> None:
    same = [TraceLatency(SAMPLES).to_json(), TraceLatency(SAMPLES).to_json()]
    other = TraceLatency((*SAMPLES, 1)).to_json()

    assert same[0] == same[1] != other
    assert list(islice(other, 1)) == ["trace_sha256"]


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
    assert parse_latency(text).on_route("r")(DecisionFacts(123_000)) == expected


def test_a_host_stage_is_charged_for_what_it_did() -> None:
    text = "host-stage{source=fps:10, per_iteration_us=500, per_cell_us=10,"
    charge = parse_latency(f"{text} per_call_us=2000}}").on_route("r")

    assert charge(NOTHING) == 100_000
    busy = DecisionFacts(0, host_iterations=12, host_cells=40)
    assert charge(busy) == 100_000 + 2_000 + 6_000 + 400


@pytest.mark.parametrize(
    "text",
    [
        *("none", "fps:10", "fixed:3", "measured"),
        "limited{source=fps:20, fps=10}",
        "host-stage{source=limited{source=measured, fps=30}, per_iteration_us=3000}",
        "host-stage{source=none, per_iteration_us=5}",
    ],
)
def test_ours_have_the_form_of_a_latency_source(text: str) -> None:
    check_form(LATENCY_SOURCES.parse(text), LATENCY_SOURCES)


def test_a_seed_reaches_a_trace_without_one_through_layers() -> None:
    text = "limited{source=host-stage{source=trace, per_iteration_us=1}, fps=10}"
    own = text.replace("trace,", "trace{seed=3},")
    source = with_draws(parse_latency(text), 3)

    assert source == parse_latency(own) == with_draws(parse_latency(own), 5)
    assert source.lacks_trace
    assert not source.with_trace((1, 2), 3.0).lacks_trace


def test_what_a_layer_has_of_the_source_below() -> None:
    """Whether it is measured; not a study's trace."""
    assert parse_latency("limited{source=measured, fps=10}").measures
    assert not parse_latency("limited{source=none, fps=10}").measures
    with pytest.raises(EvaluationError, match=r"names no file \(trace:FILE\)"):
        Drive(parse_latency("limited{source=trace, fps=10}"))


latencies = st.lists(st.integers(0, 600_000), min_size=1, max_size=12)
steps = st.sampled_from([50_000, 25_000, 10_000])


@pytest.mark.parametrize(
    ("latency_us", "skipped"),
    [
        *((0, 0), (49_999, 0), (50_000, 0), (99_999, 0), (100_000, 1), (130_000, 1)),
        *((149_999, 1), (150_000, 2), (250_000, 4), (850_000, 16)),
    ],
)
def test_equation_4_at_20_hz(latency_us: int, skipped: int) -> None:
    assert skipped_decisions(latency_us) == skipped


@given(st.integers(0, 5_000_000), steps)
def test_equation_4_in_exact_fractions(latency_us: int, dt_us: int) -> None:
    seconds, dt = Fraction(latency_us, 10**6), Fraction(dt_us, 10**6)

    assert skipped_decisions(latency_us, dt_us) == max(0, int(seconds / dt) - 1)


def by_the_text(latencies_us: list[int], dt_us: int) -> tuple[list[int], list[int]]:
    """Decision d is number d, the initial control -1: (acting, deciding) frames.

    Written frame by frame from the rule: the control in force before frame k stays
    for k .. k + n, the new one acts from k + n + 1, where the next is decided; with
    n = 0 it acts at once.
    """
    acting, deciding, before = list[int](), list[int](), -1
    for number, latency_us in enumerate(latencies_us):
        n = max(0, latency_us // dt_us - 1)
        deciding.append(len(acting))
        acting += [number if n == 0 else before] * (n + 1)
        before = number
    return acting, deciding


@given(latencies, steps)
def test_the_clock_follows_the_rule(latencies_us: list[int], dt_us: int) -> None:
    clock = ControlClock(-1, dt_us)
    expected, expected_decisions = by_the_text(latencies_us, dt_us)

    acting, decided_at = list[int](), list[int]()
    for frame in range(len(expected)):
        if clock.decision_is_due:
            clock.decide(len(decided_at), latencies_us[len(decided_at)])
            decided_at.append(frame)
        acting.append(clock.advance())

    assert acting == expected
    assert decided_at == expected_decisions
    assert clock.decision_is_due


@pytest.mark.parametrize(
    ("latency_us", "frames"),
    [(0, 0), (1, 1), (50_000, 1), (50_001, 2), (150_000, 3), (430_000, 9)],
)
def test_a_pipeline_delays_by_the_frames_begun(latency_us: int, frames: int) -> None:
    assert delayed_frames(latency_us) == frames


@given(latencies, steps)
def test_a_pipeline_is_a_queue(latencies_us: list[int], dt_us: int) -> None:
    """Decision k is out when it and all before it are ready; the newest out acts."""
    clock = ControlClock(-1, dt_us, LatencyModel.FIFO)
    ready = [k + -(-latency_us // dt_us) for k, latency_us in enumerate(latencies_us)]

    for frame, latency_us in enumerate(latencies_us):
        assert clock.decision_is_due
        clock.decide(frame, latency_us)
        out = [k for k in range(frame + 1) if max(ready[: k + 1]) <= frame]
        assert clock.advance() == max(out, default=-1)


def test_without_latency_both_models_act_at_once() -> None:
    for model in LatencyModel:
        clock = ControlClock(-1, model=model)
        clock.decide(0, 0)
        assert clock.advance() == 0


@pytest.mark.parametrize("charged", [50.5, -3, float("nan")])
@pytest.mark.parametrize("count", [skipped_decisions, delayed_frames])
def test_what_is_no_whole_microseconds_is_refused(
    count: Callable[[Any], int], charged: object
) -> None:
    with pytest.raises(EvaluationError, match="must be whole microseconds, 0 or more"):
        count(charged)
