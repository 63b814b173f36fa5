import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from me2e_compress.errors import EvaluationError, StudyError
from me2e_compress.evaluators.results import ResultsFolder
from me2e_compress.metrics.scores import score
from me2e_compress.study import (
    Listener,
    StudyResult,
    Timing,
    Variant,
    load_study,
    run_study,
)
from me2e_compress.study.definition import FramesToRecord
from tests.study.conftest import BLIND, IDEAL, ROUTES, SLOW, Here, Make

STUDY = """
title = "Killed"
baseline = "blind"
routes = 8

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


def without_latency(record: dict[str, Any]) -> dict[str, Any]:
    for table in (record, *record["schemes"]):
        del table["latency"]
    return record


def test_the_scores_are_those_of_the_results(found: StudyResult) -> None:
    folder = found.contrasts[0].picture.parents[1] / "results" / "fast.slow"
    episodes = tuple(ResultsFolder.open(folder).episodes().values())

    drive = found.under(SLOW)[-1]

    assert drive.scores == score(episodes, 220)
    assert drive.scores is not None
    assert drive.scores.partial


def test_the_same_model_does_not_differ_and_the_baseline_is_not_compared(
    found: StudyResult,
) -> None:
    blind, slow, again, fast = (each.difference for each in found.under(IDEAL))

    assert slow is None
    assert again is not None
    assert again.driving_score.value == 0.0
    assert (
        again.driving_score.low != again.driving_score.high
    )  # two routes prove little
    assert fast is not None
    assert blind is not None
    assert fast.better + fast.worse > 0


def test_a_model_has_size_and_latency_and_a_driver_has_none(found: StudyResult) -> None:
    blind, slow, again, fast = found.variants

    assert blind.size_mb.value is None
    assert blind.size_mb.reason == "no model"
    assert blind.latency_ms[50].value is None
    assert slow.size_mb.value == Path(slow.prepared.variant.policy).stat().st_size / 1e6
    assert slow.latency_ms[50].value == pytest.approx(200.0)
    assert again.latency_ms[50].value is not None
    assert fast.latency_ms[99].reason == "needs 100 samples, has 20"


def test_fidelity_is_measured_against_the_baseline(found: StudyResult) -> None:
    blind, slow, again, fast = (each.fidelity for each in found.variants)

    assert blind.mean_m.reason == "blind is not a model"
    assert slow.mean_m.reason == "the baseline itself"
    assert again.mean_m.value == 0.0
    assert again.plan_sqnr_db.reason == "no noise: equal to the bit"
    assert fast.mean_m.value == pytest.approx(sum(range(2, 14, 2)) / 6)
    assert fast.max_m.value == pytest.approx(12.0)
    assert fast.frames == 2


def test_a_picture_shows_where_two_drives_part(found: StudyResult) -> None:
    [contrast] = found.contrasts

    gaps = [
        abs(one.driving_score - other.driving_score)
        for drive in found.drives
        for one, other in zip(
            found.under(IDEAL if drive.condition == "ideal" else SLOW)[1].routes,
            drive.routes,
            strict=True,
        )
    ]
    here = abs(contrast.route.driving_score - contrast.other.driving_score)
    assert here == max(gaps)
    assert contrast.picture.read_bytes().startswith(b"\x89PNG")
    longest = max(contrast.route.duration_us, contrast.other.duration_us)
    assert 0 < contrast.moment_us <= longest


def test_the_same_seed_gives_the_same_bytes(
    found: StudyResult, make: Make, tmp_path: Path
) -> None:
    again = run_study(make(), tmp_path, Here(), pictures=0)

    one, two = (
        json.dumps(without_latency(outcome.to_json())) for outcome in (found, again)
    )
    assert one == two


def test_what_is_there_is_not_made_again(make: Make, tmp_path: Path) -> None:
    asked = make(**ONE, timing=Timing())
    engine, again = Here(), Here()

    one = run_study(asked, tmp_path, engine, pictures=0)
    two = run_study(asked, tmp_path, again, pictures=0)

    assert [route for _, route in engine.driven] != []
    assert again.driven == []
    assert one == two


def test_a_study_is_silent_and_its_file_is_taken_as_it_is(
    make: Make, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    toml = tmp_path / "study.toml"
    toml.write_text(STUDY.replace("routes = 8", "routes = 1"))

    found = run_study(toml, tmp_path / "out", Here(), pictures=0)

    assert capfd.readouterr() == ("", "")
    assert found.study == load_study(toml)


def test_studies_share_what_they_have_in_common(make: Make, tmp_path: Path) -> None:
    engine = Here()
    faster = Variant("faster", "blind:9")
    first = make(**ONE, timing=Timing())
    second = replace(first, variants=(faster, BLIND))

    run_study(first, tmp_path, Here(), pictures=0)
    run_study(second, tmp_path, engine, pictures=0)

    assert {name for name, _ in engine.driven} == {"blind:9"}


def test_a_name_that_is_taken_by_another_driver(make: Make, tmp_path: Path) -> None:
    asked = make(**ONE, timing=Timing())
    run_study(asked, tmp_path, Here(), pictures=0)
    other = replace(asked, variants=(Variant("blind", "blind:9"),))

    with pytest.raises(EvaluationError, match=r"blind\.ideal: .* of another evaluatio"):
        run_study(other, tmp_path, Here(), pictures=0)


def test_a_missing_model_is_named_before_anything_drives(
    make: Make, tmp_path: Path
) -> None:
    asked = make(variants=(BLIND, Variant("slow", "gone.onnx")))

    with pytest.raises(StudyError, match=r"variant slow: gone\.onnx: no such model"):
        run_study(asked, tmp_path)
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("which", ["frames", "held_out"])
def test_frames_that_are_none_are_named_before_anything_runs(
    make: Make, tmp_path: Path, which: str
) -> None:
    asked = make(**{which: tmp_path / "gone"})

    with pytest.raises(StudyError, match=rf"^{which}: \S+/gone: no such folder"):
        run_study(asked, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_who_listens_hears_every_stage(make: Make, tmp_path: Path) -> None:
    heard = list[str]()
    asked = make(variants=make().variants[1:3], conditions=(IDEAL,))

    run_study(
        asked,
        tmp_path,
        Here(),
        Listener(lambda stage, *_: heard.append(stage)),
        pictures=0,
    )

    assert list(dict.fromkeys(heard)) == [
        "latency",
        "fidelity of again",
        "slow, ideal",
        "again, ideal",
    ]
    assert heard.count("slow, ideal") == len(ROUTES) + 1


def test_frames_of_its_own_are_of_other_routes_each(make: Make, tmp_path: Path) -> None:
    slow = make().variants[1]
    asked = make(
        variants=(slow,),
        conditions=(IDEAL,),
        routes=ROUTES[:1],
        held_out=None,
        to_record=FramesToRecord(1, 1, seed=4),
    )

    run_study(asked, tmp_path, Here(), pictures=0)

    about = [
        json.loads((tmp_path / name / "scenes.json").read_text())
        for name in ("frames", "frames-held-out")
    ]
    assert [each["seed"] for each in about] == [4, 5]
