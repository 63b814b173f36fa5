import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from me2e_compress.base.errors import EvaluationError, StudyError
from me2e_compress.evaluators.results import ResultsFolder
from me2e_compress.manager import recipe
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.metrics.scores import score
from me2e_compress.study import StudyResult, Timing, Variant, load_study, run_study
from me2e_compress.study.definition import FramesToRecord
from me2e_compress.study.drive_record import DriveRecord, compare_pairs
from me2e_compress.study.study_result import pair_table
from tests.evaluators.highway.drivers import straight_on
from tests.study.conftest import BLIND, IDEAL, ROUTES, SLOW, Make
from tests.support.in_process import Here

STUDY = """
title = "Killed"
baseline = "blind"
routes = 3

[[variant]]
name = "blind"
policy = "blind"

[[variant]]
name = "faster"
policy = "blind:12"

[[condition]]
name = "ideal"
latency = "none"
"""

pytestmark = pytest.mark.xdist_group("study")


ONE = {"variants": (BLIND,), "baseline": "blind", "conditions": (IDEAL,)}
GONE = Variant("slow", "gone.onnx")


def test_the_scores_are_those_of_the_results(result: StudyResult, folder: Path) -> None:
    folder = folder / "results" / "fast.slow"
    episodes = tuple(ResultsFolder.open(folder).episodes().values())

    drive = [drive for drive in result.drives if drive.condition == SLOW.name][-1]

    assert drive.scores == score(episodes, 220)
    assert drive.scores is not None
    assert drive.scores.partial


def test_the_same_model_does_not_differ_and_the_baseline_is_not_compared(
    result: StudyResult,
) -> None:
    ideal = [drive for drive in result.drives if drive.condition == IDEAL.name]
    blind, slow, again, fast = (drive.difference for drive in ideal)

    assert slow is None
    assert again is not None
    assert again.driving_score.value == 0.0
    # two routes prove little
    assert again.driving_score.low != again.driving_score.high
    assert fast is not None
    assert blind is not None
    assert fast.routes_better + fast.routes_worse > 0


def test_a_model_has_size_latency_and_fidelity_and_a_driver_has_none(
    result: StudyResult,
) -> None:
    blind, slow, again, fast = result.variants

    assert blind.size_mb.value is None
    assert blind.size_mb.reason == "no model"
    assert blind.latency_ms[50].value is None
    assert slow.size_mb.value == Path(slow.variant.policy).stat().st_size / 1e6
    assert slow.latency_ms[50].value == pytest.approx(200.0)
    assert again.latency_ms[50].value is not None
    assert fast.latency_ms[99].reason == "needs 100 samples, has 20"
    # fidelity is measured against the baseline
    plans = [variant.fidelity for variant in result.variants]
    reasons = [plan.plan_mean.reason for plan in plans[:2]]
    assert reasons == ["blind is not a model", "the baseline itself"]
    assert plans[2].plan_mean.value == 0.0
    assert plans[2].plan_sqnr.reason == "no noise: equal to the bit"
    assert plans[3].plan_mean.value == pytest.approx(sum(range(2, 14, 2)) / 6)
    assert plans[3].plan_max.value == pytest.approx(12.0)
    assert plans[3].frames == 2


@pytest.mark.usefixtures("short")
def test_what_is_there_is_not_made_again_and_shared_by_studies(
    make: Make, tmp_path: Path
) -> None:
    asked = make(**ONE, timing=Timing())
    engine, again = Here(), Here()

    one = run_study(asked, tmp_path, engine)
    two = run_study(asked, tmp_path, again)

    assert [route for _, route in engine.driven] != []
    assert again.driven == []
    assert one == two
    beside = replace(asked, variants=(Variant("faster", "blind:9"), BLIND))
    run_study(beside, tmp_path, again)
    assert {name for name, _ in again.driven} == {"blind:9"}
    other = replace(asked, variants=(Variant("blind", "blind:9"),))
    with pytest.raises(EvaluationError, match=r"blind\.ideal: .* of another evaluatio"):
        run_study(other, tmp_path, Here())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"variants": (BLIND, GONE)}, r"variant slow: gone\.onnx: no such model"),
        ({"frames": Path("no/gone")}, "^frames: no/gone: no such folder"),
        ({"held_out": Path("no/gone")}, "^held_out: no/gone: no such folder"),
    ],
)
def test_a_missing_model_or_frames_are_named_before_anything_runs(
    make: Make, tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(StudyError, match=message):
        run_study(make(**changes), tmp_path / "out")
    assert not (tmp_path / "out").exists()


ROOT = Path(__file__).parents[2]
KILLED = """
import sys
from pathlib import Path
from me2e_compress.study import load_study, run_study
import tests.conftest  # blind is known by this name there
from tests.support.in_process import Here

run_study(load_study(Path(sys.argv[1])), Path(sys.argv[2]), Here())
"""


def test_a_study_that_was_killed_goes_on(tmp_path: Path) -> None:
    toml = tmp_path / "study.toml"
    toml.write_text(STUDY)
    out, whole = tmp_path / "out", tmp_path / "whole"
    words = [sys.executable, "-c", KILLED, str(toml), str(out)]
    with subprocess.Popen(words, start_new_session=True, cwd=ROOT) as running:
        limit = time.monotonic() + 300.0
        while not list(out.glob("results/*/routes/*.json")):
            assert running.poll() is None
            assert time.monotonic() < limit
            time.sleep(0.02)
        os.killpg(running.pid, signal.SIGKILL)
    finished, engine = out.glob("results/*/routes/*.json"), Here()
    done = {(path.parts[-3].removesuffix(".ideal"), path.stem) for path in finished}
    names = {"blind": "blind", "blind:12": "faster"}

    resumed = run_study(load_study(toml), out, engine)
    driven = {(names[name], route) for name, route in engine.driven}

    assert 1 <= len(done) < 6
    assert len(done) + len(engine.driven) == 6
    assert not done & driven
    assert resumed == run_study(load_study(toml), whole, Here())


@pytest.mark.usefixtures("short", "weights")
def test_frames_of_its_own_are_of_other_routes_each(make: Make, tmp_path: Path) -> None:
    body, outputs = "way = Identity (ahead)", "float[1, 6, 2] way"
    model = straight_on(tmp_path / "m.onnx", body=body, outputs=outputs)
    (tmp_path / "a.toml").write_text('[plan]\noutput = "way"')
    asked = make(
        variants=(Variant("slow", str(model), adapter=tmp_path / "a.toml"),),
        conditions=(IDEAL,),
        routes=ROUTES[:1],
        held_out=None,
        to_record=FramesToRecord(1, 1, seed=4),
    )

    run_study(asked, tmp_path, Here())

    for name, seed in (("frames", 4), ("frames-held-out", 5)):
        scenes = json.loads((tmp_path / name / "scenes.json").read_text())
        assert scenes["seed"] == seed


STATED = """
[modules.all]
role = "feature"
optional = ["**"]

[recurrent]
before = "kept"

[plan]
output = "way"
"""


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("by", ["map", "adapter", "policy"])
def test_state_and_plan_are_those_of_the_variant(
    make: Make, models: Path, tmp_path: Path, by: str
) -> None:
    model = straight_on(
        tmp_path / "m.onnx",
        inputs="int64[1] command, float[1, 2] before",
        body="kept = Identity (before) way = Add (ahead, kept)",
        outputs="float[1, 6, 2] way, float[1, 2] kept",
    )
    file = tmp_path / "stated.toml"
    file.write_text(STATED[STATED.index("[rec") :] if by == "adapter" else STATED)
    given = {
        "map": Variant("given", str(model), module_map=str(file)),
        "adapter": Variant("given", str(model), adapter=file),
        "policy": Variant("given", f"onnx{{path={model}, module_map={file}}}"),
    }[by]
    passes = recipe.parse("eliminate-redundant")
    asked = make(
        variants=(given, replace(given, name="small", passes=passes)),
        conditions=(IDEAL,),
        routes=ROUTES[:1],
        baseline="given",
        frames=models / "frames",
        timing=Timing(2),
    )

    result = run_study(asked, tmp_path / "study", Here())

    assert all(variant.latency_ms[50].value for variant in result.variants)
    assert result.variants[1].fidelity.plan_mean.value == 0.0
    assert [len(drive.routes) for drive in result.drives] == [1, 1]


@pytest.mark.usefixtures("short")
def test_a_plan_that_is_no_number_is_told(make: Make, tmp_path: Path) -> None:
    body = "none = Sub(ahead, ahead) plan = Div(none, none)"
    lost = Variant("lost", str(straight_on(tmp_path / "lost.onnx", body=body)))
    variants = (make().variants[1], lost)
    asked = make(variants=variants, conditions=(IDEAL,), routes=ROUTES[:1])

    result = run_study(asked, tmp_path / "study", Here())

    assert result.variants[1].fidelity.plan_mean.reason == "its plan is not finite"


# Records of finished drives: what they keep, and which are not taken.


@pytest.fixture
def record(result: StudyResult, folder: Path) -> Path:
    """The record of one drive."""
    return folder / "records" / "blind.slow.jsonl"


def test_a_record_keeps_what_the_tables_need(record: Path, tmp_path: Path) -> None:
    read = DriveRecord.load(record)
    read.save(tmp_path / "again.jsonl")

    assert [route.route for route in read.routes] == [route.id for route in ROUTES]
    assert read.routes[0].latency_us == (500_000,) * 4
    assert read.made_by["set_size"] == 220
    assert record.stat().st_size < 2_000
    assert (tmp_path / "again.jsonl").read_bytes() == record.read_bytes()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda text: text[: len(text) // 2], "its last line was cut off"),
        (lambda text: text + text.splitlines()[-1] + "\n", "names route .* twice"),
        (lambda text: text.replace("completion", "finish"), "not a record of a drive"),
        (lambda text: "", "its last line was cut off"),
    ],
)
def test_a_spoilt_record_is_named(
    record: Path, tmp_path: Path, spoil: object, message: str
) -> None:
    path = tmp_path / "blind.slow.jsonl"
    path.write_text(spoil(record.read_text()))  # type: ignore[operator]

    with pytest.raises(StudyError, match=rf"^{path}: .*{message}"):
        DriveRecord.load(path)


def summary(route: str, scenario: str, score: float) -> RouteSummary:
    ended = (100.0, score == 100.0, "", (), None, None)
    made = RouteSummary(route, scenario, score, *ended, 1, 0, (), 0)
    return replace(made, ttc_exposure=(100.0 - score) / 2, at_fault=False)


def drive(variant: str, condition: str, scores: Sequence[float]) -> DriveRecord:
    routes = (summary(f"r{n}", f"type{n // 2}", own) for n, own in enumerate(scores))
    return DriveRecord(variant, condition, tuple(routes))


DRIVES = (
    drive("float", "ideal", [100, 100, 100, 60]),
    drive("int8", "ideal", [100, 100, 80, 60]),
    drive("float", "fog", [100, 90, 100, 60]),
    drive("int8", "fog", [60, 90, 80, 20]),
)


def test_a_pair_crosses_conditions_and_what_was_not_driven_is_left_out() -> None:
    asked = [("int8.fog", "float.ideal")]
    [pair] = compare_pairs(asked, DRIVES, 0)
    assert pair.driving_score.value == pytest.approx((-40 - 10 - 20 - 40) / 4)
    assert pair.driving_score.n == 4
    assert pair.success_rate.value == pytest.approx(-75.0)
    assert pair.room_kept.value == pytest.approx((-40 - 10 - 20 - 40) / 8)
    assert compare_pairs(asked, DRIVES[:3], 0) == ()


def test_a_table_of_pairs() -> None:
    class Outcome:
        """A study's outcome, so far as this table reads it."""

        pairs = compare_pairs([("int8.fog", "float.ideal")], DRIVES, 0)

    table = pair_table(Outcome())  # type: ignore[arg-type]

    assert [len(row) for row in table.rows] == [len(table.columns)]
    assert [cell.text for cell in table.rows[0][:2]] == ["int8.fog", "float.ideal"]


def without_latency(record: dict[str, Any]) -> dict[str, Any]:
    for table in (record, *record["schemes"]):
        del table["latency"]
    return record


@pytest.mark.usefixtures("short")
def test_the_same_seed_gives_the_same_bytes(make: Make, tmp_path: Path) -> None:
    _, slow, again, _ = make().variants
    asked = make(variants=(slow, again, BLIND), conditions=(SLOW,))

    one, two = (
        json.dumps(without_latency(run_study(asked, tmp_path / way, Here()).to_json()))
        for way in "ab"
    )
    assert one == two
