import json
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest

from me2e_compress.driving.latency import AgentsLatency, LimitedLatency, TraceLatency
from me2e_compress.driving.realtime import LatencyModel
from me2e_compress.errors import Me2eError, StudyError
from me2e_compress.study import Condition, Timing, run_study
from tests.study.conftest import BLIND, IDEAL, Here, Make


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "give a latency or mean_of"),
        ({"latency": "none", "mean_of": "a.b"}, "give a latency or mean_of"),
        ({"mean_of": "a.b", "limit_fps": 10.0}, "a mean has no order and takes no"),
        ({"latency": "fps:10", "in_order": True}, "fps has no option 'in_order'"),
        ({"latency": "fps:10", "limit_fps": 0.0}, "fps 0 is not a positive number"),
        ({"latency": "none", "dt_ms": 30.0}, "a step of 30 ms: it must divide 50 ms"),
        ({"latency": "none", "weather": "hail=1"}, "weather option 'hail'"),
        ({"latency": "none", "latency_model": "lifo"}, "there are drop, fifo"),
        ({"latency": "trace", "seed": -1}, "seed -1: must be 0 or more"),
        ({"latency": "agents{source=trace:t.json, per_agent_us=1}"}, "is a variant's"),
        ({"latency": "limited{source=measured, fps=10}"}, "a study knows none"),
        ({"latency": "measured"}, "none, fps:F and trace"),
        ({"latency": "trace:t.json"}, "none, fps:F and trace"),
        ({"latency": "traces"}, "none, fps:F and trace"),
        ({"latency": "fast"}, "no latency source 'fast'"),
        ({"latency": "fps:0"}, "fps 0 is not a positive number"),
        ({"latency": "fps:x"}, "fps: fps: Input should be"),
    ],
)
def test_options_that_do_not_go_together(options: dict[str, Any], words: str) -> None:
    with pytest.raises(Me2eError, match=rf"condition odd: .*{words}") as caught:
        Condition("odd", **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("condition", "words"),
    [
        (Condition("even", mean_of="blind.later"), "mean_of 'blind.later' is no VARI"),
        (Condition("even", mean_of="nobody.ideal"), "mean_of 'nobody.ideal' is no"),
        (
            Condition("fog", "none", against="fog"),
            "against 'fog' is not another condit",
        ),
        (Condition("fog", "none", against="day"), "there are ideal, fog, later"),
    ],
)
def test_a_condition_that_names_one_that_is_not_there(
    make: Make, condition: Condition, words: str
) -> None:
    conditions = (IDEAL, condition, Condition("later", "none"))
    words = words.replace("fog, later", f"{condition.name}, later")

    with pytest.raises(StudyError, match=words):
        make(conditions=conditions)


def test_own_latencies_may_be_limited_and_grow_with_the_scene() -> None:
    text = "agents{source=trace, per_agent_us=3000}"
    condition = Condition("busy", text, limit_fps=10.0, in_order=True, seed=5)

    found = condition.source(0).with_trace((70_000, 80_000), 2.0)

    trace = TraceLatency((70_000, 80_000), in_order=True, scale=2.0, seed=5)
    assert condition.traced
    assert found == LimitedLatency(AgentsLatency(trace, 3_000), 10.0)


def test_every_option_reaches_the_drive(make: Make, tmp_path: Path) -> None:
    condition = Condition(
        "all", "fps:20", latency_model="fifo", limit_fps=8.0, dt_ms=25.0,
        weather="noise=9",
    )  # fmt: skip
    made = make(
        variants=(BLIND,), baseline="blind", conditions=(condition,), timing=Timing()
    )

    found = run_study(made, tmp_path, Here(), pictures=0)

    manifest = tmp_path / "results" / "blind.all" / "evaluation.json"
    made_by = json.loads(manifest.read_text())
    assert made_by["latency"] == {"limit_us": 125_000, "of": {"fixed_us": 50_000}}
    assert made_by["latency_model"] == LatencyModel.FIFO
    assert made_by["dt_us"] == 25_000
    assert made_by["weather"]["noise"] == 9.0
    [table, *_] = found.tables()
    assert table.title.startswith("Scoreboard of blind")
    assert found.to_json()["conditions"] == [condition.to_json()]


def test_a_mean_is_that_of_the_drive_that_it_names(make: Make, tmp_path: Path) -> None:
    busy = Condition("busy", "agents{source=fps:10, per_agent_us=20000}")
    even = Condition("even", mean_of="blind.busy")
    made = make(
        variants=(BLIND,), baseline="blind", conditions=(busy, even), timing=Timing()
    )

    run_study(made, tmp_path, Here(), pictures=0)

    taken = {
        name: [
            latency
            for file in (tmp_path / "results" / f"blind.{name}" / "routes").iterdir()
            for latency in json.loads(file.read_text())["episode"]["decisions"][
                "latency_us"
            ]
        ]
        for name in ("busy", "even")
    }
    assert len(set(taken["busy"])) > 1
    assert set(taken["even"]) == {round(fmean(taken["busy"]))}


@pytest.mark.parametrize(
    ("fps", "words"),
    [("1", "1 decision a second"), ("1.67", "1.67 decisions a second")],
)
def test_one_decision_is_singular(fps: str, words: str) -> None:
    assert Condition("slow", f"fps:{fps}").described("here") == f"slow: {words}"
    limited = Condition("slow", "none", limit_fps=float(fps)).described("here")
    assert limited.endswith(f"limited to {words}")
