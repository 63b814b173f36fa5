import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.paper.periods import frames_per_decision
from me2e_compress.base.errors import Me2eError, StudyError
from me2e_compress.driving.latency import HostStageLatency, LimitedLatency, TraceLatency
from me2e_compress.driving.realtime import LatencyModel
from me2e_compress.manager import recipe
from me2e_compress.study import Condition, Study, Timing, Variant, run_study
from me2e_compress.study.definition import StudyBlock
from me2e_compress.study.drive_record import DriveRecord
from tests.docs.pages import EXAMPLE
from tests.study.conftest import BLIND, FASTER, IDEAL, ROUTES, SLOW, Make
from tests.support.in_process import Here
from tests.support.installed import install

FOG = Condition("fog", "none")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"variants": ()}, "the study has no variant"),
        ({"conditions": ()}, "the study has no condition"),
        ({"conditions": (IDEAL, IDEAL)}, "2 conditions are named ideal"),
        ({"baseline": "quick"}, "baseline: no variant quick; there are blind, slow"),
        ({"routes": ()}, "no route to drive"),
        ({"pairs": (("slow.ideal", "slow.fog"),)}, "pair: no .* slow.fog; there"),
        (
            {"conditions": (Condition("device", "trace"),), "held_out": None},
            "condition device: the latency of slow is measured on held-out frames",
        ),
        # a mean is of a drive before it
        (
            {"conditions": (IDEAL, Condition("even", mean_of="blind.fog"), FOG)},
            "mean_of: .* blind.fog;",
        ),
        (
            {"conditions": (IDEAL, Condition("even", mean_of="nobody.ideal"))},
            "even: mean_of: .* nobody.ideal;",
        ),
        (
            {"blocks": (StudyBlock("table-9", ("gone",), ("ideal",)),)},
            "block table-9: no variant gone; there are blind",
        ),
    ],
)
def test_a_study_that_could_not_be_finished(
    make: Make, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(StudyError, match=message):
        make(**changes).check()


@pytest.mark.parametrize(
    ("text", "needy"),
    [
        (recipe.to_text(recipe.load("feature-ext")), "quantize-int8"),
        (recipe.to_text(recipe.load("minus-occ")), "ablate-modules"),
        ("quantize-int8{ranges=r.json}", ""),
        ("ablate-modules{drop=[occ]}", ""),
        ("lower-int8", ""),
    ],
)
def test_some_passes_need_frames(make: Make, text: str, needy: str) -> None:
    variants = (Variant("small", "m.onnx", recipe.parse(text)),)
    if not needy:
        assert make(variants=variants, baseline="small").frames is None
        return
    words = rf"variant small: {needy} measures on recorded frames, and there are none"
    with pytest.raises(StudyError, match=words):
        make(variants=variants, baseline="small")


@pytest.mark.parametrize("name", ["", "a b", "../up", "a/b", ".hidden", "a.b"])
def test_a_name_that_is_no_folder(name: str) -> None:
    with pytest.raises(StudyError, match="a name is made of letters"):
        Variant(name, "blind")


@pytest.mark.parametrize(
    "options",
    [
        {"passes": recipe.load("exact")},
        {"adapter": Path("a.toml")},
        {"trace": Path("t.json")},
        {"module_map": "vad"},
    ],
)
def test_a_driver_that_is_no_model_takes_nothing(options: dict[str, object]) -> None:
    with pytest.raises(StudyError, match="variant e: blind is not a model"):
        Variant("e", "blind", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "give a latency or mean_of"),
        ({"latency": "none", "mean_of": "a.b"}, "give a latency or mean_of"),
        ({"latency": "none", "dt_ms": 30.0}, "a step of 30 ms: it must divide 50 ms"),
        ({"latency": "none", "weather": "hail=1"}, "weather option hail"),
        ({"latency": "none", "latency_model": "lifo"}, "there are drop, fifo"),
        ({"latency": "trace{seed=-1}"}, "seed: Input should be greater"),
        ({"latency": "host-stage{source=trace:t, per_iteration_us=1}"}, "a variant's"),
        ({"latency": "limited{source=measured, fps=10}"}, "a study knows none"),
        ({"latency": "measured"}, "none, fps:F and trace"),
        ({"latency": "trace:t.json"}, "none, fps:F and trace"),
        ({"latency": "traces"}, "none, fps:F and trace"),
        ({"latency": "fast"}, "no latency source 'fast'"),
        ({"latency": "fps:0"}, "fps: Input should be greater than 0"),
        ({"latency": "fps:x"}, "fps: fps: Input should be"),
    ],
)
def test_options_that_do_not_go_together(options: dict[str, Any], words: str) -> None:
    with pytest.raises(Me2eError, match=rf"condition odd: .*{words}") as caught:
        Condition("odd", **options)
    assert "\n" not in str(caught.value)


def test_own_latencies_may_be_limited_and_grow_with_the_scene() -> None:
    stage = "host-stage{source=trace{in_order=true, seed=5}, per_iteration_us=3000}"
    condition = Condition("busy", f"limited{{source={stage}, fps=10}}")

    source = condition.source(7).with_trace((70_000, 80_000), 2.0)

    samples = TraceLatency((70_000, 80_000), in_order=True, scale=2.0, seed=5)
    assert condition.traced
    assert source == LimitedLatency(HostStageLatency(samples, 3_000), 10.0)


@pytest.mark.usefixtures("short")
def test_every_option_reaches_the_drive(make: Make, tmp_path: Path) -> None:
    condition = Condition(
        "all", "limited{source=fps:20, fps=8}", latency_model="fifo", dt_ms=25.0,
        weather="noise=9",
    )  # fmt: skip
    alone = {"variants": (BLIND,), "baseline": "blind", "timing": Timing()}

    result = run_study(make(**alone, conditions=(condition,)), tmp_path, Here())

    manifest = tmp_path / "results" / "blind.all" / "evaluation.json"
    made_by = json.loads(manifest.read_text())
    assert made_by["latency"] == {"limit_us": 125_000, "of": {"fixed_us": 50_000}}
    assert made_by["latency_model"] == LatencyModel.FIFO
    assert made_by["dt_us"] == 25_000
    assert made_by["weather"]["noise"] == 9.0
    [table, *_] = result.tables()
    assert table.title.startswith("Scoreboard")
    assert result.to_json()["conditions"] == [condition.to_json()]


# Some variants under some conditions, and what is left to drive of them.


ASKED = Study(
    "Asked again",
    (BLIND, FASTER),
    (IDEAL, SLOW),
    "blind",
    ROUTES,
    220,
    blocks=(
        StudyBlock("table-2", ("blind",), ("ideal", "slow")),
        StudyBlock("table-3", ("blind", "faster"), ("ideal",)),
    ),
)


@pytest.mark.usefixtures("short")
def test_a_block_drives_its_variants_and_the_rest_is_left(tmp_path: Path) -> None:
    engine = Here()

    result = run_study(ASKED, tmp_path, engine)

    drives = [(drive.variant, drive.condition) for drive in result.drives]
    assert drives == [("blind", "ideal"), ("faster", "ideal"), ("blind", "slow")]
    assert len(engine.driven) == 3 * len(ROUTES)


def test_the_blocks_of_a_study_can_be_chosen() -> None:
    part = ASKED.of_blocks(["table-2"])

    assert [variant.name for variant in part.variants] == ["blind"]
    assert [condition.name for condition in part.conditions] == ["ideal", "slow"]
    with pytest.raises(StudyError, match=r"^no block 4; there are table-2, table-3$"):
        ASKED.of_blocks(["4"])


def test_a_mean_is_that_of_the_drive_that_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    source = {"agents": "me2e_example.agents:AgentsLatency"}
    install(monkeypatch, tmp_path, "ours", "me2e_compress.latency_sources", source)
    busy = Condition("busy", "agents{source=fps:2, per_agent_us=20000}")
    even = Condition("even", mean_of="faster.busy")
    names = ("busy", "even")
    blocks = (StudyBlock("tail", ("faster",), names),)
    asked = replace(ASKED, conditions=(busy, even), blocks=blocks, routes=ROUTES[:1])

    run_study(asked, tmp_path, Here())

    one, other = (
        DriveRecord.load(tmp_path / "records" / f"faster.{name}.jsonl")
        for name in names
    )
    assert len({us for route in one.routes for us in route.latency_us}) > 1
    mean_us = one.mean_latency_us
    assert {us for route in other.routes for us in route.latency_us} == {mean_us}
    assert (
        frames_per_decision(asked, even) == frames_per_decision(asked, busy) == 10
    )  # 0.5 s by 0.05 s
